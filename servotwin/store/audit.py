"""The evidence chain in one query: window, what was found of it, the version that stands on it, its effect."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from servotwin.store.links import Effect, Found, Held, Link, Step
from servotwin.store.reading import HELD, of_window
from servotwin.store.schema import WINDOWS, evidence, messages

ESTIMATES = ("glance", "estimate")
ANSWERS = ("receipt", "fallback")
EVENTS = ("hello", "fallback", "answer")
"""What an edge says by itself, of no window."""


def audit(
    connection: sa.Connection,
    servo: str,
    since: float | None,
    limit: int,
    window: tuple[str, int] | None,
    before: int | None,
) -> list[Link]:
    """The links of a servo's newest windows, newest first."""
    chosen = _chosen(servo, since, limit, window, before)
    rows = connection.execute(_chain(servo, chosen)).all()
    links: dict[int, list[Any]] = {}
    for row in rows:
        links.setdefault(row[0], []).append(row)
    return [_link(of) for of in links.values()]


def events(connection: sa.Connection, servo: str, since: float, limit: int) -> list[Found]:
    """What was not found of a window, newest first."""
    columns = [evidence.c[name] for name in Found._fields]
    apart = sa.or_(evidence.c.kind.in_(EVENTS), evidence.c.message.is_(None))
    query = sa.select(*columns).where(evidence.c.servo == servo, apart, evidence.c.made >= since)
    rows = connection.execute(query.order_by(evidence.c.id.desc()).limit(limit)).all()
    return [found for row in rows if (found := _found(row, 0)) is not None]


def _chosen(servo: str, since: float | None, limit: int, window: tuple[str, int] | None, before: int | None) -> sa.CTE:
    query = sa.select(*HELD).where(WINDOWS, messages.c.servo == servo)
    if window is not None:
        query = query.where(of_window(servo, *window))
    if since is not None:
        query = query.where(messages.c.received >= since)
    if before is not None:
        query = query.where(messages.c.id < before)
    return query.order_by(messages.c.id.desc()).limit(limit).cte("chosen")


def _chain(servo: str, chosen: sa.CTE) -> sa.Select[Any]:
    """One row for each window, finding of it, answer to it and first sign of its effect."""
    found, answer, after = (evidence.alias(name) for name in ("found", "answer", "after"))
    later = messages.alias("later")
    is_update = found.c.kind == "update"
    joined = chosen.outerjoin(found, found.c.message == chosen.c.id)
    answers = sa.and_(is_update, _about(answer, servo, found), answer.c.kind.in_(ANSWERS))
    joined = joined.outerjoin(answer, answers)
    joined = joined.outerjoin(after, sa.and_(is_update, after.c.id == _first_under(servo, found)))
    joined = joined.outerjoin(later, later.c.id == after.c.message)
    columns = [*chosen.c, *_of(found), *_of(answer), *_of(after), *(later.c[name] for name in Held._fields)]
    labelled = [column.label(f"c{i}") for i, column in enumerate(columns)]
    return sa.select(*labelled).select_from(joined).order_by(chosen.c.id.desc(), found.c.id, answer.c.id)


def _about(alias: sa.FromClause, servo: str, found: sa.FromClause) -> sa.ColumnElement[bool]:
    return sa.and_(alias.c.servo == servo, alias.c.version == found.c.version)


def _first_under(servo: str, found: sa.FromClause) -> sa.ScalarSelect[Any]:
    """The first glance or estimate of a window that was cut under an update's version."""
    first = evidence.alias("first")
    query = sa.select(sa.func.min(first.c.id)).where(_about(first, servo, found), first.c.kind.in_(ESTIMATES))
    return query.correlate(found).scalar_subquery()


def _of(alias: sa.FromClause) -> list[sa.ColumnElement[Any]]:
    return [alias.c[name] for name in Found._fields]


_HELD, _FOUND = len(Held._fields), len(Found._fields)


def _link(rows: list[Any]) -> Link:
    """Everything of one window."""
    found = {one.id: one for row in rows if (one := _found(row, _HELD)) is not None}
    estimate = next((one for one in reversed(found.values()) if one.kind in ESTIMATES), None)
    steps = [_step(one, rows, estimate) for one in found.values() if one.kind == "update"]
    rest = tuple(one for one in found.values() if one.kind != "update")
    return Link(Held(*rows[0][:_HELD]), rest, tuple(steps))


def _step(update: Found, rows: list[Any], before: Found | None) -> Step:
    mine = [row for row in rows if row[_HELD] == update.id]
    answers = {one.id: one for row in mine if (one := _found(row, _HELD + _FOUND)) is not None}
    after = _found(mine[0], _HELD + 2 * _FOUND)
    if after is None:
        return Step(update, tuple(answers.values()), None)
    window = Held(*mine[0][_HELD + 3 * _FOUND :])
    return Step(update, tuple(answers.values()), Effect(window, before, after))


def _found(row: Any, at: int) -> Found | None:
    values = row[at : at + _FOUND]
    if values[0] is None:
        return None
    found = Found(*values)
    return found._replace(message=found.message or 0, context=found.context or "")
