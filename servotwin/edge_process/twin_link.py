"""The link to the twin that a configuration asks for."""

from __future__ import annotations

from collections.abc import Callable

from servotwin.edge_process.config import EdgeConfig, password_of, token_of
from servotwin.link.broker import Broker
from servotwin.link.courier import Courier
from servotwin.link.http import HttpTransport
from servotwin.link.listener import Listener
from servotwin.link.mqtt import MqttTransport
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.link.transport import Transport

CURSOR = "cursor"
"""Under which the outbox remembers the last message of the twin's that was handled."""


def transport_of(config: EdgeConfig) -> Transport | None:
    """What carries messages; None: there is no twin."""
    twin = config.twin
    if twin is None:
        return None
    ca_file = None if twin.ca_file is None else str(config.path(twin.ca_file))
    token = token_of(twin, config.folder)
    if twin.over_mqtt:
        broker = Broker(twin.url, twin.user, password_of(twin, config.folder), ca_file)
        return MqttTransport(broker, config.agent.servo, token, twin.timeout_s, twin.wait_s)
    return HttpTransport(twin.url, config.agent.servo, token, ca_file, twin.timeout_s, twin.wait_s)


def courier_of(
    config: EdgeConfig, outbox: SqliteOutbox, transport: Transport | None, chance: Callable[[], float]
) -> Courier | None:
    """Who sends; None: there is no twin."""
    return None if transport is None else Courier(outbox, transport, config.agent.retry, chance)


def listener_of(
    config: EdgeConfig, outbox: SqliteOutbox, transport: Transport | None, chance: Callable[[], float]
) -> Listener | None:
    """Who listens; None: there is no twin."""
    if transport is None or config.twin is None:
        return None
    token = token_of(config.twin, config.folder)
    return Listener(transport, config.agent.servo, token, outbox.recall(CURSOR), config.agent.retry, chance)
