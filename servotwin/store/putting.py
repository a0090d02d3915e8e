"""Incoming messages into the tables, each once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from servotwin.store.address import SQLITE
from servotwin.store.rows import Incoming, Kind, Put
from servotwin.store.schema import bodies, messages, twins

Name = tuple[str, str]
"""(servo, key)."""


def put(connection: sa.Connection, items: Sequence[Incoming]) -> list[Put]:
    """Keep what is new; what became of each."""
    if not items:
        return []
    firsts: dict[Name, Incoming] = {}
    for item in items:
        firsts.setdefault((item.servo, item.key), item)
    _know(connection, {item.servo for item in items})
    made = _insert(connection, _in_order(firsts.values()))
    _announce(connection, [firsts[name] for name in made])
    digests = {name: firsts[name].digest for name in made} | _digests(connection, firsts.keys() - made.keys())
    return [_became(item, item is firsts[item.servo, item.key], made, digests) for item in items]


@lru_cache(maxsize=8)
def insert_once(dialect: str, table: sa.Table) -> Any:
    """An insertion that leaves alone what is there already."""
    chosen = sqlite.insert if dialect == SQLITE else postgresql.insert
    return chosen(table).on_conflict_do_nothing()


def _became(item: Incoming, first: bool, made: Mapping[Name, int], digests: Mapping[Name, bytes]) -> Put:
    name = item.servo, item.key
    if first and name in made:
        return Put.NEW
    return Put.KNOWN if digests[name] == item.digest else Put.CONFLICT


def _in_order(items: Iterable[Incoming]) -> list[Incoming]:
    """Servo by servo, as every transaction takes its locks; of one servo as they came."""
    return sorted(items, key=lambda item: item.servo)


def _know(connection: sa.Connection, servos: Iterable[str]) -> None:
    connection.execute(insert_once(connection.dialect.name, twins), [{"servo": servo} for servo in sorted(servos)])


def _insert(connection: sa.Connection, items: Sequence[Incoming]) -> dict[Name, int]:
    """Ids of those that were not there."""
    rows = connection.execute(_inserting(connection.dialect.name), [_row(item) for item in items])
    made = {(servo, key): id_ for id_, servo, key in rows}
    filled = [{"message": made[i.servo, i.key], "body": i.body} for i in items if (i.servo, i.key) in made]
    if filled:
        connection.execute(sa.insert(bodies), filled)
    return made


@lru_cache(maxsize=2)
def _inserting(dialect: str) -> Any:
    return insert_once(dialect, messages).returning(messages.c.id, messages.c.servo, messages.c.key)


def _row(item: Incoming) -> dict[str, Any]:
    row = item._asdict()
    del row["body"]
    return row | {"kind": item.kind.value}


def _announce(connection: sa.Connection, new: Sequence[Incoming]) -> None:
    """Tell the servos' twins that work waits.

    The row is always written, changed or not: on PostgreSQL that waits for an outcome of the same servo that is being
    committed and has not seen these messages.
    """
    if not new:
        return
    windows = Counter(item.servo for item in new if item.kind is Kind.WINDOW)
    rows = [
        {
            "_servo": servo,
            "_windows": windows[servo],
            "_heard": max((i.received for i in of if i.kind is not Kind.PROOF), default=None),
            "_ready": min((i.received for i in of if i.kind is not Kind.PROOF), default=None),
            "_asked": min((i.received for i in of if i.kind is Kind.PROOF), default=None),
        }
        for servo, of in _by_servo(new)
    ]
    connection.execute(_ANNOUNCE, rows)


def _by_servo(items: Sequence[Incoming]) -> list[tuple[str, list[Incoming]]]:
    found: dict[str, list[Incoming]] = {}
    for item in items:
        found.setdefault(item.servo, []).append(item)
    return sorted(found.items())


def _digests(connection: sa.Connection, names: Iterable[Name]) -> dict[Name, bytes]:
    return {(row.servo, row.key): row.digest for row in named(connection, _NAMED, names)}


def named(connection: sa.Connection, query: sa.Select[Any], names: Iterable[Name]) -> Iterator[sa.Row[Any]]:
    """Rows of the messages that have these names, of a query for `_keys` of a `_servo`.

    Servo by servo: for a list of pairs SQLite walks over all messages that there are.
    """
    keys: dict[str, list[str]] = {}
    for servo, key in sorted(names):
        keys.setdefault(servo, []).append(key)
    for servo, of in keys.items():
        yield from connection.execute(query, {"_servo": servo, "_keys": of})


def of_names(*columns: sa.ColumnElement[Any]) -> sa.Select[Any]:
    """A query for `named`."""
    keys: sa.BindParameter[Any] = sa.bindparam("_keys", expanding=True)
    query = sa.select(messages.c.servo, messages.c.key, *columns)
    return query.where(messages.c.servo == sa.bindparam("_servo"), messages.c.key.in_(keys))


def _extreme(column: sa.Column[Any], name: str, *, least: bool) -> sa.ColumnElement[Any]:
    """The lesser, or greater, of a column and a value, either of which may be null."""
    value = sa.bindparam(name, type_=sa.Double)
    taken = column > value if least else column < value
    return sa.case((column.is_(None), value), (taken, value), else_=column)


_ANNOUNCE = (
    sa.update(twins)
    .where(twins.c.servo == sa.bindparam("_servo"))
    .values(
        windows=twins.c.windows + sa.bindparam("_windows", type_=sa.BigInteger),
        heard=_extreme(twins.c.heard, "_heard", least=False),
        ready=_extreme(twins.c.ready, "_ready", least=True),
        asked=_extreme(twins.c.asked, "_asked", least=True),
    )
)

_NAMED = of_names(messages.c.digest)
