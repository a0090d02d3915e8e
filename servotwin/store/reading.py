"""What the store tells: messages to the edges, summaries, single windows."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import sqlalchemy as sa

from servotwin.store.links import Held
from servotwin.store.rows import Kind, Posted, Stored, Summary, Waiting
from servotwin.store.schema import PROOFS, WINDOWS, WORK, bodies, messages, twins
from servotwin.store.schema import contexts as texts
from servotwin.store.schema import outgoing as posts

_NAMES = 5000
HELD = tuple(messages.c[name] for name in Held._fields)


def outgoing(connection: sa.Connection, servo: str, after: int, limit: int) -> list[Posted]:
    """Messages to the edge after a serial."""
    query = sa.select(posts.c.serial, posts.c.body).where(posts.c.servo == servo, posts.c.serial > after)
    return [Posted(row.serial, row.body) for row in connection.execute(query.order_by(posts.c.serial).limit(limit))]


def posted(connection: sa.Connection, servos: Collection[str]) -> dict[str, int]:
    """The newest serials; asked in parts, as no database takes any number of names at once."""
    names, found = list(servos), dict[str, int]()
    for begin in range(0, len(names), _NAMES):
        query = sa.select(twins.c.servo, twins.c.posted).where(twins.c.servo.in_(names[begin : begin + _NAMES]))
        found.update((servo, serial) for servo, serial in connection.execute(query))
    return found


def waiting(connection: sa.Connection, now: float) -> Waiting:
    """What is not yet processed."""
    counts = [sa.select(sa.func.count()).select_from(messages).where(queue) for queue in (WORK, PROOFS)]
    first = sa.select(sa.func.min(twins.c.ready)).where(twins.c.ready.is_not(None))
    query = sa.select(*(count.scalar_subquery() for count in counts), first.scalar_subquery())
    found: Any = connection.execute(query).one()
    work, proofs, oldest = found
    return Waiting(work, proofs, 0.0 if oldest is None else max(0.0, now - oldest))


def servos(connection: sa.Connection, after: str, limit: int) -> list[Summary]:
    """Summaries by name."""
    query = _SUMMARY.where(twins.c.servo > after).order_by(twins.c.servo).limit(limit)
    return [Summary(*row) for row in connection.execute(query)]


def servo(connection: sa.Connection, name: str) -> Summary | None:
    """One summary."""
    row = connection.execute(_SUMMARY.where(twins.c.servo == name)).one_or_none()
    return None if row is None else Summary(*row)


def window(connection: sa.Connection, servo: str, boot: str, sequence: int) -> Stored | None:
    """A window with its body."""
    columns = messages.c.id, messages.c.kind, bodies.c.body, messages.c.encoding, messages.c.received
    joined = messages.outerjoin(bodies, bodies.c.message == messages.c.id)
    query = sa.select(*columns).select_from(joined).where(of_window(servo, boot, sequence))
    row = connection.execute(query).one_or_none()
    return None if row is None else Stored(row.id, Kind(row.kind), row.body or b"", row.encoding, row.received)


def windows(connection: sa.Connection, servo: str, limit: int, before: int | None) -> list[Held]:
    """Windows without bodies."""
    query = sa.select(*HELD).where(WINDOWS, messages.c.servo == servo)
    if before is not None:
        query = query.where(messages.c.id < before)
    return [Held(*row) for row in connection.execute(query.order_by(messages.c.id.desc()).limit(limit))]


def contexts(connection: sa.Connection, keys: Collection[str]) -> dict[str, str]:
    """Texts of contexts."""
    rows = connection.execute(sa.select(texts.c.key, texts.c.text).where(texts.c.key.in_(keys)))
    return {row.key: row.text for row in rows}


def of_window(servo: str, boot: str, sequence: int) -> sa.ColumnElement[bool]:
    """The one window of that name."""
    return sa.and_(messages.c.servo == servo, messages.c.key == f"{boot}/{sequence}", WINDOWS)


def _count(queue: sa.ColumnElement[bool]) -> sa.ColumnElement[int]:
    counted = sa.select(sa.func.count()).select_from(messages).where(queue, messages.c.servo == twins.c.servo)
    return counted.correlate(twins).scalar_subquery().label("waiting")


_SUMMARY = sa.select(*(_count(WORK) if name == "waiting" else twins.c[name] for name in Summary._fields))
