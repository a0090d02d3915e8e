"""Messages to the edges: read in the order of their serials, and posted outside of work results."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import sqlalchemy as sa

from servotwin.store.records import OutgoingMessage
from servotwin.store.schema import outgoing, twins

_NAMES_PER_QUERY = 5000


def after_serial(connection: sa.Connection, servo: str, after: int, limit: int) -> list[OutgoingMessage]:
    """Messages to the edge with serials above `after`."""
    query = sa.select(outgoing.c.serial, outgoing.c.body).where(outgoing.c.servo == servo, outgoing.c.serial > after)
    rows = connection.execute(query.order_by(outgoing.c.serial).limit(limit))
    return [OutgoingMessage(row.serial, row.body) for row in rows]


def newest_serials(connection: sa.Connection, servos: Collection[str]) -> dict[str, int]:
    """Serials of the newest messages to the edges of these servos."""
    names, newest = list(servos), dict[str, int]()
    for begin in range(0, len(names), _NAMES_PER_QUERY):  # a database takes only so many parameters at once
        part = names[begin : begin + _NAMES_PER_QUERY]
        query = sa.select(twins.c.servo, twins.c.posted).where(twins.c.servo.in_(part))
        newest.update((servo, serial) for servo, serial in connection.execute(query))
    return newest


def post(connection: sa.Connection, sent: Mapping[str, bytes], now: float) -> None:
    """Append a message to each edge's, outside of any result; unknown servos are left out."""
    for servo, body in sorted(sent.items()):
        newer = sa.update(twins).where(twins.c.servo == servo).values(posted=twins.c.posted + 1)
        serial = connection.execute(newer.returning(twins.c.posted)).scalar()
        if serial is not None:
            row = {"servo": servo, "serial": serial, "body": body, "created": now}
            connection.execute(sa.insert(outgoing), row)


def skip_to_serial(connection: sa.Connection, servo: str, serial: int) -> None:
    """Make the serial of the next message to the edge exceed `serial`."""
    behind = sa.update(twins).where(twins.c.servo == servo, twins.c.posted < serial)
    connection.execute(behind.values(posted=serial))
