"""Servos with work to do, lent to one worker at a time."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import sqlalchemy as sa

from servotwin.store.rows import Claim, Kind, Stored
from servotwin.store.schema import PROOFS, WORK, bodies, messages, states, twins


def lend(
    connection: sa.Connection,
    owner: str,
    limit: int,
    until: float,
    now: float,
    kinds: Collection[Kind],
    only: str | None,
) -> list[str]:
    """Lease the servos that have waited longest; those due to be woken get half of the places at least."""
    lent: list[str] = []
    for condition, order, share in _queues(now, kinds, limit):
        wanted = min(share, limit - len(lent))
        # One that ends later than any made by now comes from before a clock was set back.
        late = until + (until - now)
        free = sa.or_(twins.c.lease_until.is_(None), twins.c.lease_until <= now, twins.c.lease_until > late)
        query = sa.select(twins.c.servo).where(condition, free).order_by(order).limit(wanted)
        if only is not None:
            query = query.where(twins.c.servo == only)
        # SQLite has one writer at a time, and leaves this out.
        found = connection.scalars(query.with_for_update(skip_locked=True)).all()
        _lease(connection, found, owner, until)
        lent += found
    return lent


def release(connection: sa.Connection, owner: str, servos: Collection[str] | None = None) -> None:
    """End an owner's leases: all of them, or those of some servos."""
    ending = sa.update(twins).where(twins.c.lease_owner == owner).values(lease_owner=None, lease_until=None)
    connection.execute(ending if servos is None else ending.where(twins.c.servo.in_(servos)))


def claims(connection: sa.Connection, servos: Sequence[str], kinds: Collection[Kind], per_servo: int) -> list[Claim]:
    """What there is to do for servos that are lent, in their order."""
    columns = twins.c.servo, states.c.state, twins.c.serial, twins.c.attempts
    query = sa.select(*columns).outerjoin(states, states.c.servo == twins.c.servo).where(twins.c.servo.in_(servos))
    rows = {row.servo: row for row in connection.execute(query)}
    undone = _undone(connection, servos, kinds, per_servo)
    return [
        Claim(servo, rows[servo].state or b"", rows[servo].serial, tuple(undone[servo]), rows[servo].attempts)
        for servo in servos
    ]


def woken(connection: sa.Connection, servos: Collection[str], now: float) -> set[str]:
    """Which of them are due to be woken."""
    return set(connection.scalars(sa.select(twins.c.servo).where(twins.c.servo.in_(servos), twins.c.wake <= now)))


def _queues(
    now: float, kinds: Collection[Kind], limit: int
) -> list[tuple[sa.ColumnElement[bool], sa.ColumnElement[float], int]]:
    """(whose turn it is, in which order, how many at most)."""
    found: list[tuple[sa.ColumnElement[bool], sa.ColumnElement[float], int]] = []
    if Kind.WINDOW in kinds or Kind.LETTER in kinds:
        found.append((twins.c.wake <= now, twins.c.wake, (limit + 1) // 2))
        found.append((twins.c.ready.is_not(None), twins.c.ready, limit))
        found.append((twins.c.wake <= now, twins.c.wake, limit))
    if Kind.PROOF in kinds:
        found.append((twins.c.asked.is_not(None), twins.c.asked, limit))
    return found


def _lease(connection: sa.Connection, servos: Sequence[str], owner: str, until: float) -> None:
    if servos:
        lent = {"lease_owner": owner, "lease_until": until, "attempts": twins.c.attempts + 1}
        connection.execute(sa.update(twins).where(twins.c.servo.in_(servos)).values(lent))


def _undone(
    connection: sa.Connection, servos: Sequence[str], kinds: Collection[Kind], per_servo: int
) -> dict[str, list[Stored]]:
    found: dict[str, list[Stored]] = {servo: [] for servo in servos}
    for queue, of in ((WORK, {Kind.WINDOW, Kind.LETTER}), (PROOFS, {Kind.PROOF})):
        wanted = of & set(kinds)
        if wanted:
            for row in connection.execute(_oldest(servos, queue, wanted, per_servo)):
                found[row.servo].append(Stored(row.id, Kind(row.kind), row.body, row.encoding, row.received, row.key))
    return found


def _oldest(
    servos: Sequence[str], queue: sa.ColumnElement[bool], kinds: Collection[Kind], per_servo: int
) -> sa.Select[Any]:
    place = sa.func.row_number().over(partition_by=messages.c.servo, order_by=messages.c.id).label("place")
    waiting = sa.select(messages.c.id, place).where(queue, messages.c.servo.in_(servos))
    if len(kinds) == 1 and Kind.PROOF not in kinds:
        waiting = waiting.where(messages.c.kind.in_([kind.value for kind in kinds]))
    first = waiting.subquery()
    known = (messages.c[name] for name in ("servo", "id", "kind", "encoding", "received", "key"))
    columns = *known, bodies.c.body
    joined = first.join(messages, messages.c.id == first.c.id).join(bodies, bodies.c.message == messages.c.id)
    return sa.select(*columns).select_from(joined).where(first.c.place <= per_servo).order_by(messages.c.id)
