"""Leases of servos with pending work, one worker each; and results of that work, stored as a whole or not at all."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from servotwin.store.engine import SQLITE
from servotwin.store.incoming import insert_once, put, rows_by_name, select_by_name
from servotwin.store.records import EvidenceRecord, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.store.schema import VERIFICATIONS, WORK, bodies, contexts, evidence, messages, outgoing, states, twins

MAX_LEASE_BYTES = 4 * 1024 * 1024
"""Bytes of the bodies in one lease; its first body may be larger."""
BACKLOG_LATER_S = 60.0
"""s for which other servos' new messages come before the rest of a servo's backlog. It only orders the queue."""


def acquire(
    connection: sa.Connection,
    owner: str,
    limit: int,
    until: float,
    now: float,
    kinds: Collection[MessageKind],
    only: str | None,
) -> list[str]:
    """Lease the servos whose new messages have waited longest; servos due to be woken get at least half of the places.

    A single place goes to the servo that has waited longest for either. Returns their names.
    """
    leased: list[str] = []
    # A lease that ends later than any granted by now dates from before a clock was set back: it counts as expired.
    bound = {"_now": now, "_late": until + (until - now)} | ({} if only is None else {"_only": only})
    queues = _queues(frozenset(kinds), only is not None)
    if limit == 1:
        heads = [
            (connection.execute(query, bound | {"_count": 1}).one_or_none(), n) for n, (query, _) in enumerate(queues)
        ]
        oldest = sorted((head[1], n) for head, n in heads if head is not None)[:1]
        queues = [queues[n] for _, n in oldest]
    for query, share in queues:
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


def renew(connection: sa.Connection, owner: str, servos: Collection[str], until: float) -> None:
    """Extend an owner's leases of some servos; those that it has lost stay lost."""
    mine = sa.update(twins).where(twins.c.lease_owner == owner, twins.c.servo.in_(servos))
    connection.execute(mine.values(lease_until=until))


def hold(connection: sa.Connection, servo: str, until: float) -> None:
    """Lease a servo to nobody, unless somebody has it: its next turn is after `until`."""
    free = sa.update(twins).where(twins.c.servo == servo, twins.c.lease_owner.is_(None))
    connection.execute(free.values(lease_owner=_NOBODY, lease_until=until))


def load(
    connection: sa.Connection,
    servos: Sequence[str],
    kinds: Collection[MessageKind],
    per_servo: int,
    newest_first: bool,
) -> list[Lease]:
    """State and pending messages of leased servos, in their order."""
    rows = {row.servo: row for row in connection.execute(_STATES, {"_servos": servos})}
    pending = _pending(connection, servos, kinds, per_servo, newest_first)
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
    if kinds - {MessageKind.VERIFICATION}:
        due, ready = twins.c.wake <= _NOW, twins.c.ready.is_not(None)
        # Half of the places at most before those with messages, the rest after them: neither queue can starve the
        # other.
        queues.append((_next(due, twins.c.wake, one), 0.5))
        queues.append((_next(ready, twins.c.ready, one), 1.0))
        queues.append((_next(due, twins.c.wake, one), 1.0))
    if MessageKind.VERIFICATION in kinds:
        queues.append((_next(twins.c.verification_ready.is_not(None), twins.c.verification_ready, one), 1.0))
    return queues


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
    for queue in _NEWEST_FIRST if newest_first else _OLDEST_FIRST:
        selected = queue & set(kinds)
        if selected:
            query = _few_messages(selected, newest_first and MessageKind.WINDOW in selected)
            for row in connection.execute(query, {"_servos": servos, "_per_servo": per_servo}):
                pending[row.servo].append(
                    StoredMessage(row.id, MessageKind(row.kind), row.body, row.encoding, row.received, row.key)
                )
    return {servo: sorted(found, key=_work_before_verifications) for servo, found in pending.items()}


def _work_before_verifications(message: StoredMessage) -> tuple[bool, int]:
    return message.kind is MessageKind.VERIFICATION, message.id


_OLDEST_FIRST = (frozenset(MessageKind) - {MessageKind.VERIFICATION}, frozenset({MessageKind.VERIFICATION}))
_NEWEST_FIRST = tuple(frozenset({kind}) for kind in MessageKind)
"""Kinds that share the places of a lease: where a part of the windows stays behind, no letter may."""


@lru_cache(maxsize=16)
def _few_messages(kinds: frozenset[MessageKind], newest: bool) -> sa.Select[Any]:
    """Query of the first, or newest, pending messages of each servo, of these kinds: verifications only, or others."""
    verifications = MessageKind.VERIFICATION in kinds
    order = messages.c.id.desc() if newest else messages.c.id.asc()
    place = sa.func.row_number().over(partition_by=messages.c.servo, order_by=order).label("place")
    waiting = sa.select(messages.c.id, messages.c.servo, place)
    waiting = waiting.where(VERIFICATIONS if verifications else WORK, messages.c.servo.in_(_SERVOS))
    if len(kinds) == 1 and not verifications:
        waiting = waiting.where(messages.c.kind.in_([kind.value for kind in kinds]))
    first = waiting.subquery()
    few = first.c.place <= sa.bindparam("_per_servo", type_=sa.Integer)
    so_far = sa.func.sum(sa.func.length(bodies.c.body)).over(partition_by=first.c.servo, order_by=first.c.place)
    sized = sa.select(first.c.id, first.c.place, so_far.label("so_far")).join(bodies, bodies.c.message == first.c.id)
    some = sized.where(few).subquery()
    known = (messages.c[name] for name in ("servo", "id", "kind", "encoding", "received", "key"))
    joined = some.join(messages, messages.c.id == some.c.id).join(bodies, bodies.c.message == messages.c.id)
    small = sa.or_(some.c.place == 1, some.c.so_far <= MAX_LEASE_BYTES)
    return sa.select(*known, bodies.c.body).select_from(joined).where(small).order_by(messages.c.id)


_NOBODY = "nobody"
"""Owner of the leases that only hold a servo."""
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


_ESTIMATES = ("glance", "estimate")


def commit(connection: sa.Connection, results: Sequence[WorkResult], now: float) -> list[bool]:
    """Write the results whose serial is still the servo's; returns for each whether it was written.

    The comparison of serials makes every effect happen exactly once, whoever holds the lease: of two workers that had
    the same servo the first to commit wins, and the result of the other is void.
    """
    valid = _valid(connection, results)
    if valid:
        _write(connection, [(results[i], last) for i, last in valid.items()], now)
    return [i in valid for i in range(len(results))]


def _valid(connection: sa.Connection, results: Sequence[WorkResult]) -> dict[int, int]:
    """Lock the servos; returns index of each valid result -> serial of its last message to the edge, in lock order."""
    if not results:
        return {}
    servos = sorted({result.servo for result in results})
    rows = connection.execute(_locked_serials(connection.dialect.name), {"_servos": servos})
    serials = {row.servo: (row.serial, row.posted) for row in rows}
    valid: dict[int, int] = {}
    # Stable: results of one servo stay in their order, so that the serial of each follows on the one before.
    for i in sorted(range(len(results)), key=lambda i: results[i].servo):
        serial, posted = serials.get(results[i].servo, (None, 0))
        # A later result of the same servo in this batch has to name the serial after this one.
        if results[i].serial == serial:
            valid[i] = posted + len(results[i].outgoing)
            serials[results[i].servo] = serial + 1, valid[i]
    return valid


def _write(connection: sa.Connection, valid: Sequence[tuple[WorkResult, int]], now: float) -> None:
    results = [result for result, _ in valid]
    _advance(connection, valid)
    _states(connection, results)
    _done(connection, results, now)
    known = {key: text for result in results for key, text in result.contexts}
    _insert_all(
        connection,
        insert_once(connection.dialect.name, contexts),
        ({"key": key, "text": text} for key, text in sorted(known.items())),
    )
    records = [(result.servo, record) for result in results for record in result.evidence]
    windows = _windows(connection, records)
    _insert_all(connection, sa.insert(evidence), (_evidence_row(servo, each, windows, now) for servo, each in records))
    _insert_all(
        connection, sa.insert(outgoing), (row for result, last in valid for row in _outgoing_rows(result, last, now))
    )
    put(connection, [item for result in results for item in result.enqueue])
    connection.execute(_RESCHEDULE, _places_in_queue(results, now))


def _advance(connection: sa.Connection, valid: Sequence[tuple[WorkResult, int]]) -> None:
    """Advance the servos' serials, end their leases and update their summaries.

    Consecutive results that set the same columns share one statement.
    """
    rows = [(_summary(result.evidence), result, last) for result, last in valid]
    for names, alike in groupby(rows, lambda row: tuple(sorted(row[0]))):
        bound = [
            {f"_{name}": value for name, value in known.items()}
            | {"_servo": result.servo, "_serial": result.serial + 1, "_posted": last, "_wake": result.wake}
            for known, result, last in alike
        ]
        connection.execute(_advancing(names), bound)


def _states(connection: sa.Connection, results: Sequence[WorkResult]) -> None:
    rows = [{"servo": result.servo, "state": result.state} for result in results]
    connection.execute(_upsert_state(connection.dialect.name), rows)


def _done(connection: sa.Connection, results: Sequence[WorkResult], now: float) -> None:
    rows = [
        {"_servo": result.servo, "_id": message, "_now": now}
        for result in results
        for message in dict.fromkeys(result.done)
    ]
    # Every message is completed once: a result that covers another's message would make an effect happen twice.
    if rows and connection.execute(_DONE, rows).rowcount != len(rows):
        servos = ", ".join(sorted({result.servo for result in results}))
        raise ValueError(f"work result of {servos}: covers a message that is not an unprocessed one of its own")


def _insert_all(connection: sa.Connection, statement: Any, rows: Iterable[dict[str, Any]]) -> None:
    bound = list(rows)
    if bound:
        connection.execute(statement, bound)


def _windows(connection: sa.Connection, records: Sequence[tuple[str, EvidenceRecord]]) -> dict[tuple[str, str], int]:
    """Ids of the windows that evidence names, by (servo, key)."""
    rows = rows_by_name(connection, _WINDOW_IDS, {(servo, record.window) for servo, record in records if record.window})
    return {(row.servo, row.key): row.id for row in rows if row.kind == MessageKind.WINDOW}


def _evidence_row(
    servo: str, record: EvidenceRecord, windows: Mapping[tuple[str, str], int], now: float
) -> dict[str, Any]:
    row = record._asdict()
    del row["overtaken"]
    message = windows.get((servo, row.pop("window")), record.message)
    return row | {"message": message or None, "context": record.context or None, "servo": servo, "created": now}


def _outgoing_rows(result: WorkResult, last: int, now: float) -> list[dict[str, Any]]:
    first = last - len(result.outgoing) + 1
    return [
        {"servo": result.servo, "serial": first + i, "body": body, "created": now}
        for i, body in enumerate(result.outgoing)
    ]


def _summary(records: Sequence[EvidenceRecord]) -> dict[str, Any]:
    """Columns of the servo's row that a new estimate, update or receipt sets."""
    known: dict[str, Any] = {}
    for record in records:
        if record.kind in _ESTIMATES and not record.overtaken:
            known |= {"gap": record.gap, "std": record.std, "status": record.status}
        elif record.kind == "update":
            known["version"] = record.version
        elif record.kind == "receipt":
            known["receipt"] = record.status
    return known


_WINDOW_IDS = select_by_name(messages.c.id, messages.c.kind)

_DONE = (
    sa.update(messages)
    .where(messages.c.id == sa.bindparam("_id"), messages.c.servo == sa.bindparam("_servo"), messages.c.done.is_(None))
    .values(done=sa.bindparam("_now", type_=sa.Double))
)


@lru_cache(maxsize=2)
def _locked_serials(dialect: str) -> sa.Select[Any]:
    """Select and lock the serials of servos in the lock order of `incoming.put`: by code points, whatever the collation
    of the database. The lock allows other messages to refer to the row (FOR NO KEY UPDATE).
    """
    order = twins.c.servo if dialect == SQLITE else twins.c.servo.collate("C")
    servos: sa.BindParameter[Any] = sa.bindparam("_servos", expanding=True)
    query = sa.select(twins.c.servo, twins.c.serial, twins.c.posted).where(twins.c.servo.in_(servos))
    return query.order_by(order).with_for_update(key_share=True)


@lru_cache(maxsize=32)
def _advancing(names: tuple[str, ...]) -> sa.Update:
    """Update of a servo's serial and of these columns."""
    new = {name: sa.bindparam(f"_{name}", type_=twins.c[name].type) for name in ("serial", "posted", "wake", *names)}
    values = {"attempts": 0, "lease_owner": None, "lease_until": None} | new
    return sa.update(twins).where(twins.c.servo == sa.bindparam("_servo")).values(values)


@lru_cache(maxsize=2)
def _upsert_state(dialect: str) -> Any:
    """Insert or replace a servo's state."""
    new = (sqlite.insert if dialect == SQLITE else postgresql.insert)(states)
    return new.on_conflict_do_update(index_elements=[states.c.servo], set_={"state": new.excluded.state})


def _places_in_queue(results: Sequence[WorkResult], now: float) -> list[dict[str, Any]]:
    """Parameters of `_RESCHEDULE`: of each servo the newest message that was processed, and the backlog's turn."""
    newest: dict[str, int] = {}
    for result in results:
        newest[result.servo] = max((*result.done, newest.get(result.servo, 0)))
    later = now + BACKLOG_LATER_S
    return [{"_servo": servo, "_newest": id_, "_later": later} for servo, id_ in sorted(newest.items())]


def _oldest_time(queue: sa.ColumnElement[bool]) -> sa.ScalarSelect[Any]:
    oldest = sa.select(messages.c.received).where(queue, messages.c.servo == twins.c.servo)
    return oldest.order_by(messages.c.id).limit(1).correlate(twins).scalar_subquery()


def _next_turn() -> sa.ColumnElement[float]:
    """Place in the queue: as of the oldest message that came after those processed, or of a backlog, or null."""
    newer = messages.c.id > sa.bindparam("_newest", type_=sa.BigInteger)
    left = sa.select(messages.c.id).where(WORK, messages.c.servo == twins.c.servo).correlate(twins).exists()
    backlog = sa.case((left, sa.bindparam("_later", type_=sa.Double)), else_=sa.null())
    return sa.func.coalesce(_oldest_time(sa.and_(WORK, newer)), backlog)


# A separate statement after the serials were advanced: on PostgreSQL those rows are locked by then. Messages put before
# that are seen here; a later put waits for the lock and marks the servo itself.
_RESCHEDULE = (
    sa.update(twins)
    .where(twins.c.servo == sa.bindparam("_servo"))
    .values(ready=_next_turn(), verification_ready=_oldest_time(VERIFICATIONS))
)
