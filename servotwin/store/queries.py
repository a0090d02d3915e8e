"""Queries: messages to the edges, summaries, windows, and the evidence chain of a window in one statement."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import sqlalchemy as sa

from servotwin.messages import Reason
from servotwin.store.records import (
    Backlog,
    MessageKind,
    ServoSummary,
    StoredEvidence,
    StoredMessage,
    StoredWindow,
    UpdateEffect,
    UpdateTrace,
    WindowTrace,
)
from servotwin.store.schema import VERIFICATIONS, WINDOWS, WORK, bodies, evidence, messages, twins
from servotwin.store.schema import contexts as context_table
from servotwin.store.set_aside import without

_ESTIMATES = ("glance", "estimate")
_ANSWERS = ("receipt", "fallback")
_LETTERS = (MessageKind.LETTER.value, MessageKind.ACT.value)
_APPLIED = Reason.APPLIED.value
_EVENTS = ("hello", "fallback", "answer", "act")
"""Kinds of evidence that an edge reports by itself, not about a window, and acts of engineers."""
_WINDOW_COLUMNS = tuple(messages.c[name] for name in StoredWindow._fields)


def backlog(connection: sa.Connection, now: float, aside: Collection[str] = ()) -> Backlog:
    """Number, age and lag of the unprocessed messages, but for those of servos `aside`."""
    counted, first = sa.select(sa.func.count()).select_from(messages), sa.select(sa.func.min(messages.c.id)).where(WORK)
    counts = [without(counted.where(queue), messages.c.servo, aside) for queue in (WORK, VERIFICATIONS)]
    firsts = [_first_turn(turn, aside) for turn in (twins.c.ready, twins.c.estimate_ready)]
    first_id = without(first, messages.c.servo, aside).scalar_subquery()
    oldest_of = sa.select(messages.c.received).where(messages.c.id == first_id)
    query = sa.select(*(each.scalar_subquery() for each in (*counts, *firsts, oldest_of)))
    row: Any = connection.execute(query).one()
    work, verifications, *turns, oldest = row
    age, *lags = (0.0 if since is None else max(0.0, now - since) for since in (oldest, *turns))
    return Backlog(work, verifications, age, max(lags))


def turn_lag(connection: sa.Connection, now: float, aside: Collection[str] = ()) -> float:
    """Longest time (s) for which new messages of a servo have waited for its turn; backlogs have theirs later."""
    first = connection.scalar(_first_turn(twins.c.ready, aside))
    return 0.0 if first is None else max(0.0, now - first)


def _first_turn(turn: sa.Column[float], aside: Collection[str]) -> sa.Select[Any]:
    return without(sa.select(sa.func.min(turn)).where(turn.is_not(None)), twins.c.servo, aside)


def servos(connection: sa.Connection, after: str, limit: int, aside: Collection[str] = ()) -> list[ServoSummary]:
    """Summaries by name, but for servos `aside`."""
    query = without(_SUMMARY, twins.c.servo, aside).where(twins.c.servo > after).order_by(twins.c.servo).limit(limit)
    return [ServoSummary(*row) for row in connection.execute(query)]


def servo_summaries(connection: sa.Connection, names: Collection[str]) -> list[ServoSummary]:
    """Summaries of these servos, by name."""
    query = _SUMMARY.where(twins.c.servo.in_(names)).order_by(twins.c.servo)
    return [ServoSummary(*row) for row in connection.execute(query)]


def servo(connection: sa.Connection, name: str) -> ServoSummary | None:
    """Summary of one servo."""
    row = connection.execute(_SUMMARY.where(twins.c.servo == name)).one_or_none()
    return None if row is None else ServoSummary(*row)


def window(connection: sa.Connection, servo: str, boot: str, sequence: int) -> StoredMessage | None:
    """A window with its body."""
    joined = messages.outerjoin(bodies, bodies.c.message == messages.c.id)
    query = sa.select(messages.c.id, messages.c.kind, bodies.c.body, messages.c.encoding, messages.c.received)
    query = query.select_from(joined).where(_is_window(servo, boot, sequence))
    row = connection.execute(query).one_or_none()
    if row is None:
        return None
    return StoredMessage(row.id, MessageKind(row.kind), row.body or b"", row.encoding, row.received)


def windows(connection: sa.Connection, servo: str, limit: int, before: int | None) -> list[StoredWindow]:
    """Windows without bodies, newest first."""
    query = sa.select(*_WINDOW_COLUMNS).where(WINDOWS, messages.c.servo == servo)
    if before is not None:
        query = query.where(messages.c.id < before)
    return [StoredWindow(*row) for row in connection.execute(query.order_by(messages.c.id.desc()).limit(limit))]


def contexts(connection: sa.Connection, keys: Collection[str]) -> dict[str, str]:
    """Texts of contexts by key."""
    table = context_table
    rows = connection.execute(sa.select(table.c.key, table.c.text).where(table.c.key.in_(keys)))
    return {row.key: row.text for row in rows}


def events(connection: sa.Connection, servo: str, since: float, limit: int) -> list[StoredEvidence]:
    """Evidence that belongs to no window, from the first of a time on in the order of the store, newest first."""
    columns = evidence_columns(evidence)
    apart = sa.or_(evidence.c.kind.in_(_EVENTS), evidence.c.message.is_(None))
    found = sa.and_(evidence.c.servo == servo, apart)
    # Not by time: what came after the clock was set back came later.
    first = sa.select(sa.func.min(evidence.c.id)).where(found, evidence.c.created >= since).scalar_subquery()
    query = sa.select(*columns).where(found, evidence.c.id >= first)
    rows = connection.execute(query.order_by(evidence.c.id.desc()).limit(limit)).all()
    return [record for row in rows if (record := _evidence(row, 0)) is not None]


def audit(
    connection: sa.Connection,
    servo: str,
    since: float | None,
    limit: int,
    window: tuple[str, int] | None,
    before: int | None,
    updates: bool = False,
) -> list[WindowTrace]:
    """Traces of a servo's newest windows, newest first; `updates`: only of those that led to an update."""
    query = sa.select(*_WINDOW_COLUMNS).where(WINDOWS, messages.c.servo == servo)
    if window is not None:
        query = query.where(_is_window(servo, *window))
    if since is not None:
        query = query.where(messages.c.received >= since)
    if before is not None:
        query = query.where(messages.c.id < before)
    if updates:
        sent = sa.select(evidence.c.message).where(evidence.c.servo == servo, evidence.c.kind == "update")
        query = query.where(messages.c.id.in_(sent))
    selected = query.order_by(messages.c.id.desc()).limit(limit).cte("chosen")
    rows_of: dict[int, list[Any]] = {}
    for row in connection.execute(_chain(servo, selected)).all():
        rows_of.setdefault(row[0], []).append(row)
    return [_window_trace(rows) for rows in rows_of.values()]


def _chain(servo: str, selected: sa.CTE) -> sa.Select[Any]:
    """One row per window, evidence of it, answer to it and first sign of its effect."""
    found, answer, after = (evidence.alias(name) for name in ("found", "answer", "after"))
    later = messages.alias("later")
    is_update = found.c.kind == "update"
    joined = selected.outerjoin(found, found.c.message == selected.c.id)
    answers = sa.and_(is_update, _same_version(answer, servo, found), answer.c.kind.in_(_ANSWERS))
    joined = joined.outerjoin(answer, answers)
    joined = joined.outerjoin(after, sa.and_(is_update, after.c.id == _first_estimate_under(servo, found)))
    joined = joined.outerjoin(later, later.c.id == after.c.message)
    columns = [
        *selected.c,
        *evidence_columns(found, letters=False),
        *evidence_columns(answer),
        *evidence_columns(after, letters=False),
        *(later.c[name] for name in StoredWindow._fields),
    ]
    labelled = [column.label(f"c{i}") for i, column in enumerate(columns)]
    return sa.select(*labelled).select_from(joined).order_by(selected.c.id.desc(), found.c.id, answer.c.id)


def _same_version(alias: sa.FromClause, servo: str, found: sa.FromClause) -> sa.ColumnElement[bool]:
    return sa.and_(alias.c.servo == servo, alias.c.version == found.c.version)


def _first_estimate_under(servo: str, found: sa.FromClause) -> sa.ScalarSelect[Any]:
    """Id of the first glance or estimate of a window that was cut under an update's version."""
    first = evidence.alias("first")
    query = sa.select(sa.func.min(first.c.id)).where(_same_version(first, servo, found), first.c.kind.in_(_ESTIMATES))
    return query.correlate(found).scalar_subquery()


_WIDTH, _EVIDENCE_WIDTH = len(StoredWindow._fields), len(StoredEvidence._fields)


def _window_trace(rows: list[Any]) -> WindowTrace:
    """The trace of one window from its rows."""
    records = {record.id: record for row in rows if (record := _evidence(row, _WIDTH)) is not None}
    estimate = next((record for record in reversed(records.values()) if record.kind in _ESTIMATES), None)
    updates = tuple(_update_trace(record, rows, estimate) for record in records.values() if record.kind == "update")
    rest = tuple(record for record in records.values() if record.kind != "update")
    return WindowTrace(StoredWindow(*rows[0][:_WIDTH]), rest, updates)


def _update_trace(update: StoredEvidence, rows: list[Any], before: StoredEvidence | None) -> UpdateTrace:
    matching = [row for row in rows if row[_WIDTH] == update.id]
    answers = {each.id: each for row in matching if (each := _evidence(row, _WIDTH + _EVIDENCE_WIDTH)) is not None}
    after = _evidence(matching[0], _WIDTH + 2 * _EVIDENCE_WIDTH)
    # A fallback may have taken the number of an update that came too late: what follows is not the update's effect.
    refused = bool(answers) and all(each.kind == "receipt" and each.status != _APPLIED for each in answers.values())
    if after is None or refused:
        return UpdateTrace(update, tuple(answers.values()), None)
    window = StoredWindow(*matching[0][_WIDTH + 3 * _EVIDENCE_WIDTH :])
    return UpdateTrace(update, tuple(answers.values()), UpdateEffect(window, before, after))


def _evidence(row: Any, offset: int) -> StoredEvidence | None:
    """The evidence in a row's columns from `offset` on; None: the outer join found none."""
    values = row[offset : offset + _EVIDENCE_WIDTH]
    if values[0] is None:
        return None
    return evidence_of_row(values)


def evidence_of_row(row: Any) -> StoredEvidence:
    """The evidence in the first columns of a row, null as the empty value."""
    record = StoredEvidence(*row[:_EVIDENCE_WIDTH])
    return record._replace(message=record.message or 0, context=record.context or "")


def evidence_columns(table: sa.FromClause, letters: bool = True) -> list[sa.ColumnElement[Any]]:
    """Columns of `StoredEvidence`; not `letters`: of evidence of windows, which has none that led to it."""
    letter = messages.alias("letter")
    came = sa.select(letter.c.received).where(letter.c.id == table.c.message, letter.c.kind.in_(_LETTERS))
    received: sa.ColumnElement[Any] = came.correlate(table).scalar_subquery() if letters else sa.null()
    return [*(table.c[name] for name in StoredEvidence._fields[:-1]), received.label("received")]


def _is_window(servo: str, boot: str, sequence: int) -> sa.ColumnElement[bool]:
    return sa.and_(messages.c.servo == servo, messages.c.key == f"{boot}/{sequence}", WINDOWS)


def _count(queue: sa.ColumnElement[bool]) -> sa.ColumnElement[int]:
    counted = sa.select(sa.func.count()).select_from(messages).where(queue, messages.c.servo == twins.c.servo)
    return counted.correlate(twins).scalar_subquery().label("waiting")


_SUMMARY = sa.select(*(_count(WORK) if name == "waiting" else twins.c[name] for name in ServoSummary._fields))
