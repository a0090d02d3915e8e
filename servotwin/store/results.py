"""Results of the work for servos, stored as a whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from servotwin.store.engine import SQLITE
from servotwin.store.incoming import insert_once, put, rows_by_name, select_by_name
from servotwin.store.records import EvidenceRecord, MessageKind, WorkResult
from servotwin.store.row_statement import RowStatement
from servotwin.store.schema import VERIFICATIONS, WORK, contexts, evidence, messages, outgoing, states, twins

BACKLOG_LATER_S = 60.0
"""s for which other servos' new messages come before the rest of a servo's backlog. It only orders the queue."""
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
    _PUT_STATE.run(connection, ({"servo": result.servo, "state": result.state} for result in results))
    _done(connection, results, now)
    known = {key: text for result in results for key, text in result.contexts}
    _ADD_CONTEXT.run(connection, ({"key": key, "text": text} for key, text in sorted(known.items())))
    records = [(result.servo, record) for result in results for record in result.evidence]
    windows = _windows(connection, records)
    _ADD_EVIDENCE.run(connection, (_evidence_row(servo, each, windows, now) for servo, each in records))
    _ADD_OUTGOING.run(connection, (row for result, last in valid for row in _outgoing_rows(result, last, now)))
    put(connection, [item for result in results for item in result.enqueue])
    _advance(connection, valid, now)


def _advance(connection: sa.Connection, valid: Sequence[tuple[WorkResult, int]], now: float) -> None:
    """Advance the servos' serials, end their leases, update their summaries and give them their places in the queue.

    Consecutive servos that set the same columns share one statement. It comes last, so that it sees which messages are
    left. On PostgreSQL the rows are locked since `_valid`: messages put before that are seen here; a later put waits
    for the lock and marks the servo itself.
    """
    summaries: dict[str, dict[str, Any]] = {}
    rows = _places_in_queue([result for result, _ in valid], now)
    for result, last in valid:
        summaries[result.servo] = summaries.get(result.servo, {}) | _summary(result.evidence)
        rows[result.servo] |= {"_serial": result.serial + 1, "_posted": last, "_wake": result.wake}
    for names, alike in groupby(rows, lambda servo: tuple(sorted(summaries[servo]))):
        bound = (rows[servo] | {f"_{name}": summaries[servo][name] for name in names} for servo in alike)
        _advancing(names).run(connection, bound)


def _done(connection: sa.Connection, results: Sequence[WorkResult], now: float) -> None:
    rows = [
        {"_servo": result.servo, "_id": message, "_now": now}
        for result in results
        for message in dict.fromkeys(result.done)
    ]
    # Every message is completed once: a result that covers another's message would make an effect happen twice.
    if _DONE.run(connection, rows) != len(rows):
        servos = ", ".join(sorted({result.servo for result in results}))
        raise ValueError(f"work result of {servos}: covers a message that is not an unprocessed one of its own")


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

_DONE = RowStatement(
    lambda _: (
        sa.update(messages)
        .where(
            messages.c.id == sa.bindparam("_id"), messages.c.servo == sa.bindparam("_servo"), messages.c.done.is_(None)
        )
        .values(done=sa.bindparam("_now", type_=sa.Double))
    )
)
_ADD_CONTEXT = RowStatement(lambda dialect: insert_once(dialect, contexts), contexts.c.keys())
_ADD_EVIDENCE = RowStatement(lambda _: sa.insert(evidence), set(evidence.c.keys()) - {"id"})
_ADD_OUTGOING = RowStatement(lambda _: sa.insert(outgoing), outgoing.c.keys())


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
def _advancing(names: tuple[str, ...]) -> RowStatement:
    """Update of a servo's serial, of these columns, and of its places in the queue."""
    new = {name: sa.bindparam(f"_{name}", type_=twins.c[name].type) for name in ("serial", "posted", "wake", *names)}
    values = {"attempts": 0, "lease_owner": None, "lease_until": None} | new
    queue = {
        "ready": _next_turn(), "verification_ready": _oldest_time(VERIFICATIONS), "estimate_ready": _next_estimate()
    }  # fmt: skip
    return RowStatement(
        lambda _: sa.update(twins).where(twins.c.servo == sa.bindparam("_servo")).values(values | queue)
    )


def _upsert_state(dialect: str) -> Any:
    """Insert or replace a servo's state."""
    new = (sqlite.insert if dialect == SQLITE else postgresql.insert)(states)
    return new.on_conflict_do_update(index_elements=[states.c.servo], set_={"state": new.excluded.state})


_PUT_STATE = RowStatement(_upsert_state, states.c.keys())


def _places_in_queue(results: Sequence[WorkResult], now: float) -> dict[str, dict[str, Any]]:
    """Parameters of the places in the queue by servo: the newest message that was looked at, and the one deferred."""
    newest: dict[str, int] = {}
    deferred: dict[str, int | None] = {}
    for result in results:
        newest[result.servo] = max((*result.done, result.deferred or 0, newest.get(result.servo, 0)))
        if result.deferred is not None:
            deferred[result.servo] = result.deferred
    times = {"_later": now + BACKLOG_LATER_S, "_now": now}
    return {
        servo: {"_servo": servo, "_newest": id_, "_deferred": deferred.get(servo), **times}
        for servo, id_ in sorted(newest.items())
    }


def _oldest_time(queue: sa.ColumnElement[bool]) -> sa.ScalarSelect[Any]:
    oldest = sa.select(messages.c.received).where(queue, messages.c.servo == twins.c.servo)
    return oldest.order_by(messages.c.id).limit(1).correlate(twins).scalar_subquery()


_DEFERRED = sa.bindparam("_deferred", type_=sa.BigInteger)


def _next_turn() -> sa.ColumnElement[float]:
    """Place in the queue: as of the oldest message that came after those looked at, or of a backlog, or null."""
    newer = messages.c.id > sa.bindparam("_newest", type_=sa.BigInteger)
    others = sa.or_(_DEFERRED.is_(None), messages.c.id != _DEFERRED)
    left = sa.select(messages.c.id).where(WORK, others, messages.c.servo == twins.c.servo).correlate(twins).exists()
    backlog = sa.case((left, sa.bindparam("_later", type_=sa.Double)), else_=sa.null())
    return sa.func.coalesce(_oldest_time(sa.and_(WORK, newer)), backlog)


def _next_estimate() -> sa.ColumnElement[float]:
    """Place among the estimates: a servo keeps it until none of its windows is deferred any more."""
    since = sa.func.coalesce(twins.c.estimate_ready, sa.bindparam("_now", type_=sa.Double))
    return sa.case((_DEFERRED.is_(None), twins.c.estimate_ready), (_DEFERRED == 0, sa.null()), else_=since)
