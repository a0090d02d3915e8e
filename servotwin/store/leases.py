"""Leases of servos with pending work, one worker each.

A servo's turn comes from one of three queues, each by the time of waiting: new messages first, then the estimates of
windows that a glance was not enough for, then backlogs.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import sqlalchemy as sa

from servotwin.store.records import LONGEST_WAKE_S, Lease, MessageKind, StoredMessage
from servotwin.store.row_statement import RowStatement
from servotwin.store.schema import VERIFICATIONS, WINDOWS, WORK, bodies, messages, states, twins
from servotwin.store.set_aside import without

MAX_LEASE_BYTES = 4 * 1024 * 1024
"""Bytes of the bodies in one lease; its first body may be larger."""
LONGEST_HOLD_S = 120.0
"""s for which a servo is held, at most."""


class Turn(NamedTuple):
    """A servo's turn, and True where it is for an estimate."""

    servo: str
    estimate: bool


def acquire(
    connection: sa.Connection,
    owner: str,
    limit: int,
    until: float,
    now: float,
    kinds: Collection[MessageKind],
    only: str | None,
    estimate_first: bool = False,
    aside: frozenset[str] = frozenset(),
) -> list[Turn]:
    """Lease the servos of the first queue in which some wait, those `aside` excepted.

    Of those with new messages the ones that have waited longest; servos due to be woken get at least half of the
    places, and a single place goes to the servo that has waited longest for either. Of estimates one servo.
    """
    # A lease that ends later than any granted by now dates from before a clock was set back: it counts as expired.
    late = now + 2.0 * max(until - now, LONGEST_HOLD_S)
    bound = {"_now": now, "_late": late, "_ahead": _ahead(now)} | ({} if only is None else {"_only": only})
    new, estimates, backlogs = _queues(frozenset(kinds), only is not None, aside)
    order = [(new, limit, False), (estimates, 1, True), (backlogs, limit, False)]
    for queues, most, estimate in [order[1], *order] if estimate_first else order:
        granted = {"_owner": owner, "_until": until}
        if most == 1:
            servos = _taken_alone(connection, queues, bound, granted)
        else:
            servos = _taken(connection, queues, most, bound, granted)
        if servos:
            return [Turn(servo, estimate) for servo in servos]
    return []


def _taken(
    connection: sa.Connection,
    queues: Sequence[_Queue],
    limit: int,
    bound: dict[str, Any],
    lease: dict[str, Any],
) -> list[str]:
    """Lease the next servos of queues that share `limit` places; returns their names."""
    leased, emptied = list[str](), set[sa.Select[Any]]()
    for query, share in queues:
        count = min(math.ceil(share * limit), limit - len(leased))
        if not count or query in emptied:
            continue
        servos = connection.scalars(query, bound | {"_count": count}).all()
        if len(servos) < count:
            emptied.add(query)
        _LEASE.run(connection, ({"_servo": servo, **lease} for servo in sorted(servos)))
        leased += servos
    return leased


def _taken_alone(
    connection: sa.Connection, queues: Sequence[_Queue], bound: dict[str, Any], lease: dict[str, Any]
) -> list[str]:
    """Lease the servo that has waited longest in any of some queues; returns its name, where there is one."""
    queries = dict.fromkeys(query for query, _ in queues)
    heads: list[Any] = [connection.execute(query, bound | {"_count": 1}).one_or_none() for query in queries]
    oldest = min((head for head in heads if head is not None), key=lambda head: head[1], default=None)
    if oldest is None:
        return []
    _LEASE.run(connection, [{"_servo": oldest.servo, **lease}])
    return [oldest.servo]


def release(
    connection: sa.Connection, owner: str, servos: Collection[str] | None = None, aside: Collection[str] = ()
) -> None:
    """End an owner's leases: all of them, but for those `aside`, or those of some servos."""
    if servos is None:
        of_owner = sa.select(twins.c.servo).where(twins.c.lease_owner == owner)
        servos = connection.scalars(without(of_owner, twins.c.servo, aside)).all()
    _CHANGE.run(connection, _changes(owner, servos, None, None))


def renew(connection: sa.Connection, owner: str, servos: Collection[str], until: float) -> None:
    """Extend an owner's leases of some servos; those that it has lost stay lost."""
    _CHANGE.run(connection, _changes(owner, servos, owner, until))


def _changes(
    owner: str, servos: Collection[str], new_owner: str | None, until: float | None
) -> Iterator[dict[str, Any]]:
    """Rows of the changed leases, in the order in which every transaction locks servos: others wait for them too."""
    return ({"_servo": servo, "_owner": owner, "_new": new_owner, "_until": until} for servo in sorted(servos))


def hold(connection: sa.Connection, servo: str, until: float) -> None:
    """Lease a servo to nobody, unless somebody has it: its next turn is after `until`."""
    free = sa.update(twins).where(twins.c.servo == servo, twins.c.lease_owner.is_(None))
    connection.execute(free.values(lease_owner=_NOBODY, lease_until=until))


def load(
    connection: sa.Connection,
    turns: Sequence[Turn],
    kinds: Collection[MessageKind],
    per_servo: int,
    newest_first: bool,
) -> list[Lease]:
    """State and pending messages of leased servos, in their order."""
    servos = [turn.servo for turn in turns]
    rows = {row.servo: row for row in connection.execute(_STATES, {"_servos": servos}).all()}
    pending = _pending(connection, servos, kinds, per_servo, newest_first)
    return [
        Lease(
            servo, rows[servo].state or b"", rows[servo].serial, tuple(pending[servo]), rows[servo].attempts, estimate
        )
        for servo, estimate in turns
    ]


def due(connection: sa.Connection, servos: Collection[str], now: float) -> set[str]:
    """Servos among these that are due to be woken."""
    return set(connection.scalars(_DUE, {"_servos": list(servos), "_now": now, "_ahead": _ahead(now)}))


def _ahead(now: float) -> float:
    """Time after which no twin whose clock is right sets a wake-up."""
    return now + 2.0 * LONGEST_WAKE_S


_Queue = tuple[sa.Select[Any], float]
"""Query of the next servos in a queue; largest share of the limit that it may take."""


@lru_cache(maxsize=32)
def _queues(
    kinds: frozenset[MessageKind], one: bool, aside: frozenset[str]
) -> tuple[list[_Queue], list[_Queue], list[_Queue]]:
    """Queues of new messages, which share the places, of estimates, and of backlogs; of `one` servo only."""

    def next_of(turn: sa.ColumnElement[bool], order: sa.ColumnElement[float]) -> sa.Select[Any]:
        return without(_next(turn, order, one), twins.c.servo, aside)

    new, estimates, backlogs = list[_Queue](), list[_Queue](), list[_Queue]()
    if kinds - {MessageKind.VERIFICATION}:
        due, ready, estimate = _IS_DUE, twins.c.ready <= _NOW, twins.c.estimate_ready.is_not(None)
        # Half of the places at most before those with messages, the rest after them: neither queue can starve the
        # other.
        woken = next_of(due, twins.c.wake)
        new += [(woken, 0.5), (next_of(ready, twins.c.ready), 1.0), (woken, 1.0)]
        estimates.append((next_of(estimate, twins.c.estimate_ready), 1.0))
        backlogs.append((next_of(twins.c.ready.is_not(None), twins.c.ready), 1.0))
    if MessageKind.VERIFICATION in kinds:
        new.append((next_of(twins.c.verification_ready.is_not(None), twins.c.verification_ready), 1.0))
    return new, estimates, backlogs


def _next(turn: sa.ColumnElement[bool], order: sa.ColumnElement[float], one: bool) -> sa.Select[Any]:
    """Query of servos whose turn it is and that are not leased."""
    until = twins.c.lease_until
    late = sa.bindparam("_late", type_=sa.Double)
    free = sa.or_(until.is_(None), until <= _NOW, until > late)
    count = sa.bindparam("_count", type_=sa.Integer)
    query = sa.select(twins.c.servo, order).where(turn, free).order_by(order).limit(count)
    query = query.where(twins.c.servo == sa.bindparam("_only")) if one else query
    # SQLite has one writer at a time and ignores this.
    return query.with_for_update(skip_locked=True)


def _pending(
    connection: sa.Connection,
    servos: Sequence[str],
    kinds: Collection[MessageKind],
    per_servo: int,
    newest_first: bool,
) -> dict[str, list[StoredMessage]]:
    """Pending messages of each servo in the order of their commits; of the windows the first ones, or the newest."""
    pending: dict[str, list[StoredMessage]] = {servo: [] for servo in servos}
    for queue in _WORK, _VERIFICATIONS:
        selected = queue & set(kinds)
        if selected:
            query = _few_messages(selected, newest_first)
            for row in connection.execute(query, {"_servos": servos, "_per_servo": per_servo}).all():
                pending[row.servo].append(
                    StoredMessage(row.id, MessageKind(row.kind), row.body, row.encoding, row.received, row.key)
                )
    return {servo: sorted(found, key=_work_before_verifications) for servo, found in pending.items()}


def _work_before_verifications(message: StoredMessage) -> tuple[bool, int]:
    return message.kind is MessageKind.VERIFICATION, message.id


_VERIFICATIONS = frozenset({MessageKind.VERIFICATION})
_WORK = frozenset(MessageKind) - _VERIFICATIONS


@lru_cache(maxsize=16)
def _few_messages(kinds: frozenset[MessageKind], newest: bool) -> sa.Select[Any]:
    """Query of the first pending messages of each servo, of these kinds: verifications only, or others.

    `newest`: of the windows the last ones. Each kind then has places of its own: where a part of the windows stays
    behind, no letter may.
    """
    sharing = ("servo", "kind") if newest else ("servo",)
    order = sa.case((WINDOWS, -messages.c.id), else_=messages.c.id) if newest else messages.c.id
    place = sa.func.row_number().over(partition_by=[messages.c[name] for name in sharing], order_by=order)
    waiting = sa.select(messages.c.id, messages.c.servo, messages.c.kind, place.label("place"))
    queue = VERIFICATIONS if kinds == _VERIFICATIONS else WORK
    waiting = waiting.where(queue, messages.c.servo.in_(_SERVOS))
    if kinds not in (_VERIFICATIONS, _WORK):
        waiting = waiting.where(messages.c.kind.in_(sorted(kind.value for kind in kinds)))
    first = waiting.subquery()
    few = first.c.place <= sa.bindparam("_per_servo", type_=sa.Integer)
    partition = [first.c[name] for name in sharing]
    so_far = sa.func.sum(sa.func.length(bodies.c.body)).over(partition_by=partition, order_by=first.c.place)
    sized = sa.select(first.c.id, first.c.place, so_far.label("so_far")).join(bodies, bodies.c.message == first.c.id)
    some = sized.where(few).subquery()
    known = (messages.c[name] for name in ("servo", "id", "kind", "encoding", "received", "key"))
    joined = some.join(messages, messages.c.id == some.c.id).join(bodies, bodies.c.message == messages.c.id)
    small = sa.or_(some.c.place == 1, some.c.so_far <= MAX_LEASE_BYTES)
    return sa.select(*known, bodies.c.body).select_from(joined).where(small).order_by(messages.c.id)


_NOBODY = "nobody"
"""Owner of the leases that only hold a servo."""
_SERVOS: sa.BindParameter[Any] = sa.bindparam("_servos", expanding=True)
_NOW, _AHEAD = (sa.bindparam(name, type_=sa.Double) for name in ("_now", "_ahead"))
# Where a clock was set back since, nothing else would wake a servo until it has caught up.
_IS_DUE = sa.or_(twins.c.wake <= _NOW, twins.c.wake > _AHEAD)

_LEASE = RowStatement(
    lambda _: (
        sa.update(twins)
        .where(twins.c.servo == sa.bindparam("_servo"))
        .values(
            lease_owner=sa.bindparam("_owner"),
            lease_until=sa.bindparam("_until", type_=sa.Double),
            attempts=twins.c.attempts + 1,
        )
    )
)
_CHANGE = RowStatement(
    lambda _: (
        sa.update(twins)
        .where(twins.c.servo == sa.bindparam("_servo"), twins.c.lease_owner == sa.bindparam("_owner"))
        .values(lease_owner=sa.bindparam("_new"), lease_until=sa.bindparam("_until", type_=sa.Double))
    )
)
_STATES = (
    sa.select(twins.c.servo, states.c.state, twins.c.serial, twins.c.attempts)
    .outerjoin(states, states.c.servo == twins.c.servo)
    .where(twins.c.servo.in_(_SERVOS))
)
_DUE = sa.select(twins.c.servo).where(twins.c.servo.in_(_SERVOS), _IS_DUE)
