"""Queries of the dashboard: newest facts of each servo, what changed since, gaps of its windows over time."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from servotwin.store.queries import evidence_columns, evidence_of_row, servo_summaries
from servotwin.store.records import ServoSummary, StoredEvidence, StoredWindow
from servotwin.store.schema import WINDOWS, evidence, messages, twins
from servotwin.store.set_aside import without

_ESTIMATES = ("glance", "estimate")
_NEWEST = ("trend",)
"""Kinds whose rows have no version: the newest is found in the index at once."""
_VERSIONED = ("hello", "receipt", "fallback")
"""Kinds that report the version in force."""
_COLUMNS = tuple(evidence_columns(evidence))
_WINDOW_COLUMNS = tuple(messages.c[name] for name in StoredWindow._fields)
_SERVOS: sa.BindParameter[Any] = sa.bindparam("_servos", expanding=True)


class StorePosition(NamedTuple):
    """Place in the growth of the store: ids of its newest evidence and of its newest message."""

    evidence: int
    message: int

    @property
    def text(self) -> str:
        """As an event's id."""
        return f"{self.evidence}-{self.message}"


class ServoFacts(NamedTuple):
    """The newest facts of one servo.

    Attributes
    ----------
    summary : ServoSummary
    window : StoredWindow or None
        The newest one, by boot and number.
    newest : dict of str to StoredEvidence
        Newest evidence of the kinds trend, hello, receipt and fallback, and in "window" the estimate or glance of the
        newest window.
    alarms : tuple of StoredEvidence
        Newest first.
    """

    summary: ServoSummary
    window: StoredWindow | None
    newest: dict[str, StoredEvidence]
    alarms: tuple[StoredEvidence, ...] = ()


class WindowGap(NamedTuple):
    """A window with what was found of the gap: evidence of the kinds glance, estimate, trend and redesign.

    The body of a redesign is left out.
    """

    window: StoredWindow
    evidence: tuple[StoredEvidence, ...]


def position(connection: sa.Connection) -> StorePosition:
    """Present position."""
    rows = (sa.select(sa.func.max(table.c.id)).scalar_subquery() for table in (evidence, messages))
    newest: Any = connection.execute(sa.select(*rows)).one()
    return StorePosition(newest[0] or 0, newest[1] or 0)


def changed(connection: sa.Connection, since: StorePosition, limit: int) -> list[str]:
    """Names of the servos with evidence or messages after a position; more than `limit` are cut off."""
    of_evidence = sa.select(evidence.c.servo).where(evidence.c.id > since.evidence)
    of_messages = sa.select(messages.c.servo).where(messages.c.id > since.message)
    return list(connection.scalars(sa.union(of_evidence, of_messages).limit(limit)))


def facts(connection: sa.Connection, servos: Collection[str], alarms_since: float) -> list[ServoFacts]:
    """Facts of these servos, by name; unknown ones are left out.

    Parameters
    ----------
    servos : collection of str
    alarms_since : float
        s since the epoch: only alarms from then on.
    """
    names = sorted(servos)
    if not names:
        return []
    summaries = servo_summaries(connection, names)
    newest: dict[str, dict[str, StoredEvidence]] = {name: {} for name in names}
    for kind, query in _NEWEST_OF.items():
        for row in connection.execute(query, {"_servos": names}):
            newest[row.servo][kind] = evidence_of_row(row)
    windows = _newest_windows(connection, names, newest)
    of_windows = [window.id for window in windows.values()]
    query = sa.select(*_COLUMNS, evidence.c.servo).where(evidence.c.message.in_(of_windows))
    for row in connection.execute(query.where(evidence.c.kind.in_(_ESTIMATES)).order_by(evidence.c.id)):
        newest[row.servo]["window"] = evidence_of_row(row)
    alarms: dict[str, list[StoredEvidence]] = {}
    for row in connection.execute(_ALARMS, {"_servos": names, "_since": alarms_since}):
        alarms.setdefault(row.servo, []).append(evidence_of_row(row))
    return [
        ServoFacts(each, windows.get(each.servo), newest[each.servo], tuple(alarms.get(each.servo, ())))
        for each in summaries
    ]


def _newest_windows(
    connection: sa.Connection, names: Sequence[str], newest: Mapping[str, Mapping[str, StoredEvidence]]
) -> dict[str, StoredWindow]:
    """Newest window of each servo by boot and number: after an outage, or a reordering link, it is not the last one."""
    found = {row.servo: StoredWindow(*row) for row in connection.execute(_LAST_WINDOWS, {"_servos": names})}
    for servo, window in found.items():
        hello = newest[servo].get("hello")
        if hello is not None and hello.status != window.boot:
            bound = {"_servo": servo, "_boot": hello.status, "_since": hello.message}
            row = connection.execute(_LAST_OF_BOOT, bound).one_or_none()
            found[servo] = window if row is None else StoredWindow(*row)
    ids = [window.id for window in found.values()]
    for _ in range(_REORDERED):
        following = [StoredWindow(*row) for row in connection.execute(_FOLLOWING, {"_ids": ids})] if ids else []
        found.update({window.servo: window for window in following})
        ids = [window.id for window in following]
    return found


def gaps(
    connection: sa.Connection, servo: str, limit: int, before: int | None = None, bodies: bool = True
) -> list[WindowGap]:
    """Gaps of a servo's newest windows, oldest first; without `bodies` those of the evidence are empty."""
    chosen = sa.select(*_WINDOW_COLUMNS).where(WINDOWS, messages.c.servo == servo)
    if before is not None:
        chosen = chosen.where(messages.c.id < before)
    selected = chosen.order_by(messages.c.id.desc()).limit(limit).cte("chosen")
    # The body of a redesign holds its simulations: much, and not needed here.
    body = sa.case((evidence.c.kind == "redesign", b""), else_=evidence.c.body) if bodies else sa.literal(b"")
    known = evidence_columns(evidence, letters=False)
    columns = [body.label("body") if column.name == "body" else column for column in known]
    wanted = sa.and_(evidence.c.message == selected.c.id, evidence.c.kind.in_((*_ESTIMATES, "trend", "redesign")))
    query = sa.select(*selected.c, *(column.label(f"e_{column.name}") for column in columns))
    query = query.select_from(selected.outerjoin(evidence, wanted)).order_by(selected.c.id, evidence.c.id)
    width, found = len(StoredWindow._fields), dict[StoredWindow, list[StoredEvidence]]()
    for row in connection.execute(query):
        records = found.setdefault(StoredWindow(*row[:width]), [])
        if row[width] is not None:
            records.append(evidence_of_row(row[width:]))
    return [WindowGap(window, tuple(records)) for window, records in found.items()]


def decisions(connection: sa.Connection, servo: str, limit: int) -> list[StoredEvidence]:
    """Updates, receipts, fallbacks and starts of the edge, oldest first: the newest `limit` of each kind."""
    return evidence_of_kinds(connection, servo, ("update", *_VERSIONED), limit)


def evidence_of_kinds(connection: sa.Connection, servo: str, kinds: Iterable[str], limit: int) -> list[StoredEvidence]:
    """Evidence of some kinds, oldest first: the newest `limit` of each kind."""
    rows: list[StoredEvidence] = []
    for kind in kinds:
        query = sa.select(*_COLUMNS).where(evidence.c.servo == servo, evidence.c.kind == kind)
        rows += [evidence_of_row(row) for row in connection.execute(query.order_by(evidence.c.id.desc()).limit(limit))]
    return sorted(rows, key=lambda row: row.id)


def _newest_of(kind: str) -> sa.Select[Any]:
    """Query of the newest evidence of a kind of each servo."""
    newest = evidence.alias("newest")
    last = sa.select(sa.func.max(newest.c.id)).where(newest.c.servo == twins.c.servo, newest.c.kind == kind)
    if kind in _NEWEST:
        last = last.where(newest.c.version.is_(None))
    ids = sa.select(last.correlate(twins).scalar_subquery()).where(twins.c.servo.in_(_SERVOS))
    return sa.select(*_COLUMNS, evidence.c.servo).where(evidence.c.id.in_(ids))


def _last_windows() -> sa.Select[Any]:
    """Query of the newest window of each servo."""
    newest = messages.alias("newest")
    of_servo = sa.and_(newest.c.servo == twins.c.servo, newest.c.kind == sa.literal_column("'window'"))
    last = sa.select(sa.func.max(newest.c.id)).where(of_servo).correlate(twins).scalar_subquery()
    return sa.select(*_WINDOW_COLUMNS).where(messages.c.id.in_(sa.select(last).where(twins.c.servo.in_(_SERVOS))))


def _last_of_boot() -> sa.Select[Any]:
    """Query of the last window of a servo's boot that came after a message."""
    of_boot = sa.and_(messages.c.servo == sa.bindparam("_servo"), messages.c.boot == sa.bindparam("_boot"), WINDOWS)
    later = messages.c.id > sa.bindparam("_since", type_=sa.BigInteger)
    return sa.select(*_WINDOW_COLUMNS).where(of_boot, later).order_by(messages.c.id.desc()).limit(1)


def _following() -> sa.Select[Any]:
    """Query of the windows whose numbers follow those of some."""
    before = messages.alias("before")
    number = sa.cast(before.c.sequence + 1, sa.Text)
    follows = sa.and_(messages.c.servo == before.c.servo, messages.c.key == before.c.boot + "/" + number)
    ids: sa.BindParameter[Any] = sa.bindparam("_ids", expanding=True)
    return sa.select(*_WINDOW_COLUMNS).select_from(before.join(messages, follows)).where(before.c.id.in_(ids))


_REORDERED = 64
"""Windows at most by which a later one may come before an earlier one."""
_LAST_OF_BOOT, _FOLLOWING = _last_of_boot(), _following()
_NEWEST_OF = {kind: _newest_of(kind) for kind in (*_NEWEST, *_VERSIONED)}
_LAST_WINDOWS = _last_windows()
_ALARMS_OF_A_SERVO = 50
"""Newest alarms of a servo that are read: a noisy one hides no other's."""


def _alarms() -> sa.Select[Any]:
    """Query of the newest alarms of each servo, newest first."""
    rank = sa.func.row_number().over(partition_by=evidence.c.servo, order_by=evidence.c.id.desc())
    ranked = (
        sa.select(evidence.c.id, rank.label("rank"))
        .where(
            evidence.c.servo.in_(_SERVOS),
            evidence.c.kind == "alarm",
            evidence.c.version.is_(None),
            evidence.c.created >= sa.bindparam("_since", type_=sa.Double),
        )
        .subquery()
    )
    newest = sa.select(ranked.c.id).where(ranked.c.rank <= _ALARMS_OF_A_SERVO)
    return sa.select(*_COLUMNS, evidence.c.servo).where(evidence.c.id.in_(newest)).order_by(evidence.c.id.desc())


_ALARMS = _alarms()


def names_after(connection: sa.Connection, after: str, limit: int, aside: Collection[str] = ()) -> Sequence[str]:
    """Names of the servos that follow `after`, but for those `aside`."""
    query = (
        without(sa.select(twins.c.servo), twins.c.servo, aside)
        .where(twins.c.servo > after)
        .order_by(twins.c.servo)
        .limit(limit)
    )
    return list(connection.scalars(query))
