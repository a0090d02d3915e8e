"""Leases: each servo with pending work belongs to one worker at a time."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import Any

import sqlalchemy as sa

from servotwin.store.records import Lease, MessageKind, StoredMessage
from servotwin.store.schema import VERIFICATIONS, WORK, bodies, messages, states, twins

MAX_LEASE_BYTES = 4 * 1024 * 1024
"""Bytes of the bodies in one lease; its first body may be larger."""


def acquire(
    connection: sa.Connection,
    owner: str,
    limit: int,
    until: float,
    now: float,
    kinds: Collection[MessageKind],
    only: str | None,
) -> list[str]:
    """Lease the servos that have waited longest; servos due to be woken get at least half of the places.

    Returns their names.
    """
    leased: list[str] = []
    # A lease that ends later than any granted by now dates from before a clock was set back: it counts as expired.
    bound = {"_now": now, "_late": until + (until - now)} | ({} if only is None else {"_only": only})
    for query, share in _queues(frozenset(kinds), only is not None):
        count = min(math.ceil(share * limit), limit - len(leased))
        servos = connection.scalars(query, bound | {"_count": count}).all()
        if servos:
            connection.execute(_LEASE, {"_servos": servos, "_owner": owner, "_until": until})
            leased += servos
    return leased


def release(connection: sa.Connection, owner: str, servos: Collection[str] | None = None) -> None:
    """End an owner's leases: all of them, or those of some servos."""
    ending = sa.update(twins).where(twins.c.lease_owner == owner).values(lease_owner=None, lease_until=None)
    connection.execute(ending if servos is None else ending.where(twins.c.servo.in_(servos)))


def load(
    connection: sa.Connection, servos: Sequence[str], kinds: Collection[MessageKind], per_servo: int
) -> list[Lease]:
    """State and pending messages of leased servos, in their order."""
    rows = {row.servo: row for row in connection.execute(_STATES, {"_servos": servos})}
    pending = _pending(connection, servos, kinds, per_servo)
    return [
        Lease(servo, rows[servo].state or b"", rows[servo].serial, tuple(pending[servo]), rows[servo].attempts)
        for servo in servos
    ]


def due(connection: sa.Connection, servos: Collection[str], now: float) -> set[str]:
    """Servos among these that are due to be woken."""
    return set(connection.scalars(_DUE, {"_servos": list(servos), "_now": now}))


@lru_cache(maxsize=32)
def _queues(kinds: frozenset[MessageKind], one: bool) -> list[tuple[sa.Select[Any], float]]:
    """(query of the next servos in a queue, largest share of the limit that it may take); of `one` servo only."""
    queues: list[tuple[sa.Select[Any], float]] = []
    if MessageKind.WINDOW in kinds or MessageKind.LETTER in kinds:
        due, ready = twins.c.wake <= _NOW, twins.c.ready.is_not(None)
        queues.append((_next(due, twins.c.wake, one), 0.5))
        queues.append((_next(ready, twins.c.ready, one), 1.0))
        queues.append((_next(due, twins.c.wake, one), 1.0))
    if MessageKind.VERIFICATION in kinds:
        queues.append((_next(twins.c.asked.is_not(None), twins.c.asked, one), 1.0))
    return queues


def _next(turn: sa.ColumnElement[bool], order: sa.ColumnElement[float], one: bool) -> sa.Select[Any]:
    """Query of servos whose turn it is and that are not leased."""
    until = twins.c.lease_until
    late = sa.bindparam("_late", type_=sa.Double)
    free = sa.or_(until.is_(None), until <= _NOW, until > late)
    count = sa.bindparam("_count", type_=sa.Integer)
    query = sa.select(twins.c.servo).where(turn, free).order_by(order).limit(count)
    query = query.where(twins.c.servo == sa.bindparam("_only")) if one else query
    # SQLite has one writer at a time and ignores this.
    return query.with_for_update(skip_locked=True)


def _pending(
    connection: sa.Connection, servos: Sequence[str], kinds: Collection[MessageKind], per_servo: int
) -> dict[str, list[StoredMessage]]:
    pending: dict[str, list[StoredMessage]] = {servo: [] for servo in servos}
    for queue in ({MessageKind.WINDOW, MessageKind.LETTER}, {MessageKind.VERIFICATION}):
        selected = frozenset(queue & set(kinds))
        if selected:
            for row in connection.execute(_oldest(selected), {"_servos": servos, "_per_servo": per_servo}):
                pending[row.servo].append(
                    StoredMessage(row.id, MessageKind(row.kind), row.body, row.encoding, row.received, row.key)
                )
    return pending


@lru_cache(maxsize=8)
def _oldest(kinds: frozenset[MessageKind]) -> sa.Select[Any]:
    """Query of the first pending messages of each servo, of these kinds: verifications only, or all others."""
    verifications = MessageKind.VERIFICATION in kinds
    place = sa.func.row_number().over(partition_by=messages.c.servo, order_by=messages.c.id).label("place")
    waiting = sa.select(messages.c.id, messages.c.servo, place)
    waiting = waiting.where(VERIFICATIONS if verifications else WORK, messages.c.servo.in_(_SERVOS))
    if len(kinds) == 1 and not verifications:
        waiting = waiting.where(messages.c.kind.in_([kind.value for kind in kinds]))
    first = waiting.subquery()
    few = first.c.place <= sa.bindparam("_per_servo", type_=sa.Integer)
    so_far = sa.func.sum(sa.func.length(bodies.c.body)).over(partition_by=first.c.servo, order_by=first.c.id)
    sized = sa.select(first.c.id, first.c.place, so_far.label("so_far")).join(bodies, bodies.c.message == first.c.id)
    some = sized.where(few).subquery()
    known = (messages.c[name] for name in ("servo", "id", "kind", "encoding", "received", "key"))
    joined = some.join(messages, messages.c.id == some.c.id).join(bodies, bodies.c.message == messages.c.id)
    small = sa.or_(some.c.place == 1, some.c.so_far <= MAX_LEASE_BYTES)
    return sa.select(*known, bodies.c.body).select_from(joined).where(small).order_by(messages.c.id)


_SERVOS: sa.BindParameter[Any] = sa.bindparam("_servos", expanding=True)
_NOW = sa.bindparam("_now", type_=sa.Double)

_LEASE = (
    sa.update(twins)
    .where(twins.c.servo.in_(_SERVOS))
    .values(
        lease_owner=sa.bindparam("_owner"),
        lease_until=sa.bindparam("_until", type_=sa.Double),
        attempts=twins.c.attempts + 1,
    )
)
_STATES = (
    sa.select(twins.c.servo, states.c.state, twins.c.serial, twins.c.attempts)
    .outerjoin(states, states.c.servo == twins.c.servo)
    .where(twins.c.servo.in_(_SERVOS))
)
_DUE = sa.select(twins.c.servo).where(twins.c.servo.in_(_SERVOS), twins.c.wake <= _NOW)
