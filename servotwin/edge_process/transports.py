"""Transport of a link process, over HTTP or MQTT, with the claim of its run."""

from __future__ import annotations

from collections.abc import Callable

from servotwin import __version__
from servotwin.edge_process.config import EdgeConfig, TwinLink, password_of, token_of
from servotwin.edge_process.live_view import LiveLink
from servotwin.link.claim import ClaimingTransport, ExclusiveTransport, HeldClaim
from servotwin.link.sqlite_outbox import SqliteOutbox

_CLAIM = "claim"
"""Name under which the outbox keeps the claim of the last run."""


def exclusive_transport(config: EdgeConfig, outbox: SqliteOutbox, run: str) -> ExclusiveTransport | None:
    """Make the transport of a configuration, for a run of the edge; None: there is no twin."""
    twin = config.twin
    if twin is None:
        return None
    make = _TRANSPORTS["mqtt" if twin.over_mqtt else "http"]
    # A link process that was restarted in the same run has the run's claim; one in a copied folder is another run.
    stored = HeldClaim.from_text((outbox.value(_CLAIM) or b"").decode())
    held = stored if stored is not None and stored.run == run else HeldClaim(run)
    return ExclusiveTransport(
        make(config, twin, run),
        config.agent.servo,
        held,
        lambda new: outbox.set_value(_CLAIM, new.text.encode()),
        __version__,
    )


def live_link(config: EdgeConfig) -> LiveLink | None:
    """Make the connection of the live view; None: the edge's file does not allow it."""
    twin = config.twin
    if twin is None or not twin.live:
        return None
    from servotwin.link.http import LiveHttp

    return LiveHttp(
        twin.url, config.agent.servo, link_token(config), _ca_file(config, twin), twin.timeout_s, twin.wait_s
    )


def _ca_file(config: EdgeConfig, twin: TwinLink) -> str | None:
    return None if twin.ca_file is None else str(config.path(twin.ca_file))


def _http(config: EdgeConfig, twin: TwinLink, _run: str) -> ClaimingTransport:
    from servotwin.link.http import HttpTransport

    return HttpTransport(
        twin.url, config.agent.servo, link_token(config), _ca_file(config, twin), twin.timeout_s, twin.wait_s
    )


def _mqtt(config: EdgeConfig, twin: TwinLink, run: str) -> ClaimingTransport:
    from servotwin.link.broker import Broker
    from servotwin.link.mqtt import MqttTransport

    broker = Broker(twin.url, twin.user, password_of(twin, config.folder), _ca_file(config, twin))
    return MqttTransport(broker, config.agent.servo, link_token(config), twin.timeout_s, twin.wait_s, run)


_TRANSPORTS: dict[str, Callable[[EdgeConfig, TwinLink, str], ClaimingTransport]] = {"http": _http, "mqtt": _mqtt}
"""Transports by name; each is imported when it is used."""


def link_token(config: EdgeConfig) -> str:
    """Token of the servo; empty where there is no twin."""
    return "" if config.twin is None else token_of(config.twin, config.folder)
