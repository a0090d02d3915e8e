"""Transport of a link process, over HTTP or MQTT, with the claim of its run."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from servotwin import __version__
from servotwin.edge_process.config import EdgeConfig, TwinLink, password_of, token_of
from servotwin.edge_process.live_view import LiveLink
from servotwin.link.claim import ClaimingTransport, ExclusiveTransport, FormerRuns, HeldClaim
from servotwin.link.sqlite_outbox import SqliteOutbox

if TYPE_CHECKING:
    from servotwin.link.broker import Broker

_CLAIM = "claim"
"""Name under which the outbox keeps the newest claim of its edge."""
_LAST_RUN = "run"
"""Name under which it keeps the last run, whether that reached the twin or not."""


def exclusive_transport(config: EdgeConfig, outbox: SqliteOutbox, run: str) -> ExclusiveTransport | None:
    """Make the transport of a configuration, for a run of the edge; None: there is no twin."""
    twin = config.twin
    if twin is None:
        return None
    make = _TRANSPORTS["mqtt" if twin.over_mqtt else "http"]
    # A link process that was restarted in the same run has the run's claim; one in a copied folder is another run.
    stored = HeldClaim.from_text((outbox.value(_CLAIM) or b"").decode())
    held = stored if stored is not None and stored.run == run else HeldClaim(run)
    last = (outbox.value(_LAST_RUN) or b"").decode()
    outbox.set_value(_LAST_RUN, run.encode())
    return ExclusiveTransport(
        make(config, twin, run),
        config.agent.servo,
        held,
        lambda new: outbox.set_value(_CLAIM, new.text.encode()),
        __version__,
        None if stored is None else FormerRuns(stored, last),
    )


def live_link(config: EdgeConfig, run: str) -> LiveLink | None:
    """Make the connection of the live view; None: the edge's file does not allow it."""
    twin = config.twin
    if twin is None or not twin.live:
        return None
    servo, token = config.agent.servo, token_of(config)
    if twin.over_mqtt:
        from servotwin.link.mqtt import LiveMqtt

        return LiveMqtt(_broker(config, twin), servo, token, twin.timeout_s, twin.wait_s, run)
    from servotwin.link.http import LiveHttp

    return LiveHttp(twin.url, servo, token, _ca_file(config, twin), twin.timeout_s, twin.wait_s)


def _ca_file(config: EdgeConfig, twin: TwinLink) -> str | None:
    return None if twin.ca_file is None else str(config.path(twin.ca_file))


def _http(config: EdgeConfig, twin: TwinLink, _run: str) -> ClaimingTransport:
    from servotwin.link.http import HttpTransport

    return HttpTransport(
        twin.url, config.agent.servo, token_of(config), _ca_file(config, twin), twin.timeout_s, twin.wait_s
    )


def _mqtt(config: EdgeConfig, twin: TwinLink, run: str) -> ClaimingTransport:
    from servotwin.link.mqtt import MqttTransport

    servo, token = config.agent.servo, token_of(config)
    return MqttTransport(_broker(config, twin), servo, token, twin.timeout_s, twin.wait_s, run)


def _broker(config: EdgeConfig, twin: TwinLink) -> Broker:
    from servotwin.link.broker import Broker

    return Broker(twin.url, twin.user, password_of(config), _ca_file(config, twin))


_TRANSPORTS: dict[str, Callable[[EdgeConfig, TwinLink, str], ClaimingTransport]] = {"http": _http, "mqtt": _mqtt}
"""Transports by name; each is imported when it is used."""
