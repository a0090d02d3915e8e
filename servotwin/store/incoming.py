"""Storage of incoming messages, each exactly once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from servotwin.store.engine import SQLITE
from servotwin.store.records import Incoming, MessageKind, PutResult
from servotwin.store.row_statement import RowStatement
from servotwin.store.schema import bodies, messages, twins

OVERTAKEN_LATER_S = 10.0
"""s for which other servos' new messages come before a window that was overtaken. It only orders the queue."""
Name = tuple[str, str]
"""(servo, key)."""


def put(connection: sa.Connection, items: Sequence[Incoming]) -> list[PutResult]:
    """Store the new ones; returns the result of each."""
    if not items:
        return []
    firsts: dict[Name, Incoming] = {}
    for item in items:
        firsts.setdefault((item.servo, item.key), item)
    _insert_servos(connection, {item.servo for item in items})
    ids = _insert(connection, _by_lock_order(firsts.values()))
    _mark_ready(connection, [firsts[name] for name in ids])
    digests = {name: firsts[name].digest for name in ids} | _digests(connection, firsts.keys() - ids.keys())
    return [_result_of(item, item is firsts[item.servo, item.key], ids, digests) for item in items]


@lru_cache(maxsize=8)
def insert_once(dialect: str, table: sa.Table) -> Any:
    """Insert statement that skips existing rows."""
    chosen = sqlite.insert if dialect == SQLITE else postgresql.insert
    return chosen(table).on_conflict_do_nothing()


def _result_of(item: Incoming, first: bool, ids: Mapping[Name, int], digests: Mapping[Name, bytes]) -> PutResult:
    name = item.servo, item.key
    if first and name in ids:
        return PutResult.NEW
    # A digest of another length is of another kind, as older versions made it, and says nothing.
    other = digests[name] != item.digest and len(digests[name]) == len(item.digest)
    return PutResult.CONFLICT if other else PutResult.KNOWN


def _by_lock_order(items: Iterable[Incoming]) -> list[Incoming]:
    """Sort by servo, the order in which every transaction takes its locks; the order within a servo stays."""
    return sorted(items, key=lambda item: item.servo)


def _insert_servos(connection: sa.Connection, servos: Iterable[str]) -> None:
    _ADD_SERVO.run(connection, ({"servo": servo} for servo in sorted(servos)))


def _insert(connection: sa.Connection, items: Sequence[Incoming]) -> dict[Name, int]:
    """Insert messages; returns the ids of those that were new."""
    rows = connection.execute(_inserting(connection.dialect.name), [_row(item) for item in items])
    ids = {(servo, key): id_ for id_, servo, key in rows}
    # Bodies of new messages only: a repeated one has its body already.
    _ADD_BODY.run(
        connection, ({"message": ids[i.servo, i.key], "body": i.body} for i in items if (i.servo, i.key) in ids)
    )
    return ids


@lru_cache(maxsize=2)
def _inserting(dialect: str) -> Any:
    return insert_once(dialect, messages).returning(messages.c.id, messages.c.servo, messages.c.key)


def _row(item: Incoming) -> dict[str, Any]:
    row = item._asdict()
    del row["body"], row["overtaken"]
    return row | {"kind": item.kind.value}


def _mark_ready(connection: sa.Connection, new: Sequence[Incoming]) -> None:
    """Mark the servos as having work to do.

    The row is always written, changed or not: on PostgreSQL that waits for a result of the same servo that is being
    committed and has not seen these messages.
    """
    windows = Counter(item.servo for item in new if item.kind is MessageKind.WINDOW)
    rows = [
        {
            "_servo": servo,
            "_windows": windows[servo],
            "_last_message": max((i.received for i in group if i.kind is not MessageKind.VERIFICATION), default=None),
            "_ready": min((_turn(i) for i in group if i.kind is not MessageKind.VERIFICATION), default=None),
            "_verification_ready": min((i.received for i in group if i.kind is MessageKind.VERIFICATION), default=None),
        }
        for servo, group in _by_servo(new)
    ]
    _MARK_READY.run(connection, rows)


def _turn(item: Incoming) -> float:
    """Time (s since the epoch) by which a message orders the servos that wait."""
    return item.received + OVERTAKEN_LATER_S * item.overtaken


def _by_servo(items: Sequence[Incoming]) -> list[tuple[str, list[Incoming]]]:
    groups: dict[str, list[Incoming]] = {}
    for item in items:
        groups.setdefault(item.servo, []).append(item)
    return sorted(groups.items())


def _digests(connection: sa.Connection, names: Iterable[Name]) -> dict[Name, bytes]:
    return {(row.servo, row.key): row.digest for row in rows_by_name(connection, _DIGESTS, names)}


def rows_by_name(connection: sa.Connection, query: sa.Select[Any], names: Iterable[Name]) -> Iterator[sa.Row[Any]]:
    """Rows of a query made by `select_by_name` for these (servo, key) pairs.

    One query per servo: for a list of pairs SQLite would scan the whole table.
    """
    keys: dict[str, list[str]] = {}
    for servo, key in sorted(names):
        keys.setdefault(servo, []).append(key)
    for servo, of_servo in keys.items():
        yield from connection.execute(query, {"_servo": servo, "_keys": of_servo})


def select_by_name(*columns: sa.ColumnElement[Any]) -> sa.Select[Any]:
    """Query of messages by `_servo` and `_keys`, for `rows_by_name`."""
    keys: sa.BindParameter[Any] = sa.bindparam("_keys", expanding=True)
    query = sa.select(messages.c.servo, messages.c.key, *columns)
    return query.where(messages.c.servo == sa.bindparam("_servo"), messages.c.key.in_(keys))


def _earlier(column: sa.Column[Any], name: str) -> sa.ColumnElement[Any]:
    """Minimum of a column and a value, either of which may be null."""
    value = sa.bindparam(name, type_=sa.Double)
    return sa.case((column.is_(None), value), (column > value, value), else_=column)


_ADD_SERVO = RowStatement(lambda dialect: insert_once(dialect, twins), ("servo",))
_ADD_BODY = RowStatement(lambda _: sa.insert(bodies), bodies.c.keys())
_MARK_READY = RowStatement(
    lambda _: (
        sa.update(twins)
        .where(twins.c.servo == sa.bindparam("_servo"))
        .values(
            windows=twins.c.windows + sa.bindparam("_windows", type_=sa.BigInteger),
            # Not the latest time: a clock that was ahead and is right again would hide for as long that an edge is
            # away.
            last_message=sa.func.coalesce(sa.bindparam("_last_message", type_=sa.Double), twins.c.last_message),
            ready=_earlier(twins.c.ready, "_ready"),
            verification_ready=_earlier(twins.c.verification_ready, "_verification_ready"),
        )
    )
)

_DIGESTS = select_by_name(messages.c.digest)
