"""Messages to the edges: read in the order of their serials, and posted outside of work results."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import sqlalchemy as sa

from servotwin.store.records import OutgoingMessage
from servotwin.store.schema import outgoing, twins

_NAMES_PER_QUERY = 5000


def after_serial(connection: sa.Connection, servo: str, after: int, limit: int) -> list[OutgoingMessage]:
    """Messages to the edge with serials above `after`."""
    rows = connection.execute(_AFTER_SERIAL, {"_servo": servo, "_after": after, "_limit": limit})
    return [OutgoingMessage(row.serial, row.body) for row in rows]


def newest_serials(connection: sa.Connection, servos: Collection[str]) -> dict[str, int]:
    """Serials of the newest messages to the edges of these servos."""
    names, newest = list(servos), dict[str, int]()
    for begin in range(0, len(names), _NAMES_PER_QUERY):  # a database takes only so many parameters at once
        part = names[begin : begin + _NAMES_PER_QUERY]
        newest.update((servo, serial) for servo, serial in connection.execute(_NEWEST, {"_servos": part}))
    return newest


def fresh_serial(now: float) -> int:
    """Serial above those of all messages before `now` (s since the epoch), also of a store that has lost some: ms."""
    return int(1000.0 * now)


def post(connection: sa.Connection, sent: Mapping[str, bytes], now: float, above: int = 0) -> None:
    """Append a message to each edge's, outside of any result, its serial above `above`; unknown servos are left out."""
    for servo, body in sorted(sent.items()):
        if above:
            skip_to_serial(connection, servo, above)
        newer = sa.update(twins).where(twins.c.servo == servo).values(posted=twins.c.posted + 1)
        serial = connection.execute(newer.returning(twins.c.posted)).scalar()
        if serial is not None:
            row = {"servo": servo, "serial": serial, "body": body, "created": now}
            connection.execute(sa.insert(outgoing), row)


def skip_to_serial(connection: sa.Connection, servo: str, serial: int) -> None:
    """Make the serial of the next message to the edge exceed `serial`."""
    behind = sa.update(twins).where(twins.c.servo == servo, twins.c.posted < serial)
    connection.execute(behind.values(posted=serial))


# Made once: each poll of an edge runs one or both.
_AFTER_SERIAL = (
    sa.select(outgoing.c.serial, outgoing.c.body)
    .where(outgoing.c.servo == sa.bindparam("_servo"), outgoing.c.serial > sa.bindparam("_after", type_=sa.BigInteger))
    .order_by(outgoing.c.serial)
    .limit(sa.bindparam("_limit", type_=sa.Integer))
)
_NEWEST = sa.select(twins.c.servo, twins.c.posted).where(twins.c.servo.in_(sa.bindparam("_servos", expanding=True)))
