"""Types of the columns, which check each value that is read: SQLite keeps a value of any type in any column, and a
number that counts nothing, or a time that no clock shows, makes whoever computes with it fail."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import sqlalchemy as sa

_BYTES = "bytes"
_NAMES = {float: "a number", int: "a whole number", str: "a text", bytes: _BYTES}
_STORED = {
    float: "('real', 'integer', 'null')",
    int: "('integer', 'null')",
    str: "('text', 'null')",
    bytes: "('blob', 'null')",
}
"""Types of SQLite's values that belong into columns of Python's."""


class WrongValue(Exception):
    """A value was read that does not belong into its column, of another type or content. One clause."""


class Content(NamedTuple):
    """Contents of a column: numbers from `least` to `most`, or, where there are some, one of `texts`."""

    words: str
    least: float = 0
    most: float = 0
    texts: tuple[str, ...] = ()

    def test(self, value: Any) -> bool:
        """Test a value of the column's own type."""
        return value in self.texts if self.texts else self.least <= value <= self.most

    def sql(self, column: str) -> str:
        """Condition in SQL for a value that does not belong there; a NaN of PostgreSQL is above all numbers."""
        if self.texts:
            return f"{column} NOT IN ({', '.join(map(repr, self.texts))})"
        return f"{column} NOT BETWEEN {self.least!r} AND {self.most!r}"


_COUNT = Content("a count up to 2**53", 0, 2**53)
TIME = Content("a time, in s since the epoch, before the year 10000", 0.0, 253402300799.0)


class StoredValue(sa.TypeDecorator[Any]):
    """Type of a column that refuses to give a value of another type, since whoever computed with it would fail.

    Parameters
    ----------
    type_ : TypeEngine
        Type of the column.
    column : str
        TABLE.COLUMN.
    content : Content, optional
    """

    impl: sa.types.TypeEngine[Any] | type[sa.types.TypeEngine[Any]] = sa.types.NullType
    cache_ok = True

    def __init__(self, type_: sa.types.TypeEngine[Any], column: str, content: Content | None = None) -> None:
        super().__init__()
        self.impl = type_
        self.column, self.content = column, content

    @property
    def kind(self) -> type:
        """Python's type of the values."""
        return self.impl_instance.python_type

    def result_processor(self, _dialect: sa.Dialect, _coltype: object) -> Callable[[Any], Any]:
        """Return the check; the drivers of both systems give Python's own types."""
        kind, column, content = self.kind, self.column, self.content
        wanted = (float, int) if kind is float else (kind,)

        def check(value: Any) -> Any:
            if value is None or (type(value) in wanted and (content is None or content.test(value))):
                return value
            raise WrongValue(_clause(column, kind, content, value))

        return check


class WrongRow(NamedTuple):
    """A row with a value that does not belong there.

    Attributes
    ----------
    servo : str or None
        The servo to which the row belongs; None: it concerns others too.
    clause : str
        Names the value and the row.
    message : int
        Id of the message whose body it is; 0: it is no body.
    """

    servo: str | None
    clause: str
    message: int = 0


def wrong_value(connection: sqlite3.Connection, table: sa.Table) -> str:
    """First value that does not belong into its column of an SQLite file, of any revision, in a clause; empty: none."""
    return next((row.clause for row in wrong_rows(connection, table, 1)), "")


def wrong_rows(connection: sqlite3.Connection, table: sa.Table, most: int) -> list[WrongRow]:
    """Rows of an SQLite file, of any revision, with values that do not belong into their columns.

    One row of each servo, of `most` servos at most. An earlier revision lacks some tables and columns.
    """
    known = {row[1] for row in connection.execute(f"PRAGMA table_info('{table.name}')")}
    columns = [column for column in table.columns if column.name in known]
    return _wrong_rows(connection.execute, table, columns, _typed(columns), most)


def wrong_contents(connection: sa.Connection, table: sa.Table, most: int) -> list[WrongRow]:
    """Rows of a PostgreSQL store with contents that do not belong into their columns, likewise."""
    return _wrong_rows(_executing(connection), table, table.columns, _contents(table.columns), most)


def wrong_row_of(connection: sa.Connection, table: sa.Table, servo: str) -> WrongRow | None:
    """First row of a servo, in a table that names servos, with a value that does not belong there; None: none has."""
    columns = list(table.columns)
    wrong = _typed(columns) if connection.dialect.name == "sqlite" else _contents(columns)
    return next(iter(_wrong_rows(_executing(connection), table, columns, wrong, 1, servo)), None)


_Execute = Callable[[str, dict[str, Any]], Iterable[Any]]
OWNER = "owner"
"""Key of a table's `info` with the SQL for the servo of a row, where no column names it."""


def _executing(connection: sa.Connection) -> _Execute:
    return lambda query, bound: connection.execute(sa.text(query), bound)


def _typed(columns: Iterable[sa.Column[Any]]) -> dict[str, str]:
    """Conditions for wrong types and contents by the names of all columns, in SQLite."""
    columns = list(columns)
    wrong = {column.name: f"typeof({column.name}) NOT IN {_STORED[_kind(column)]}" for column in columns}
    return wrong | {name: f"{wrong[name]} OR {condition}" for name, condition in _contents(columns).items()}


def _wrong_rows(
    execute: _Execute,
    table: sa.Table,
    columns: Iterable[sa.Column[Any]],
    wrong: Mapping[str, str],
    most: int,
    servo: str | None = None,
) -> list[WrongRow]:
    """Rows for which a column's condition holds, found in one pass over the table: of each servo the first one.

    A wrong key is nobody's alone, and comes first: whose row it was is not known.
    """
    if not wrong:  # an earlier revision lacks some tables
        return []
    columns, keys = list(columns), tuple(table.primary_key)
    shared = {each.name for each in keys} | {"servo"}
    cases = "".join(f" WHEN {condition} THEN '{name}'" for name, condition in wrong.items())
    names = ", ".join(column.name for column in columns)
    owner = "servo" if "servo" in table.columns else table.info.get(OWNER, "NULL")
    only = "" if servo is None else f" WHERE {owner} = :servo"
    rows = execute(
        f"SELECT wrong, owner, {names} FROM (SELECT *, row_number() OVER (PARTITION BY owner "
        f"ORDER BY wrong NOT IN ({', '.join(map(repr, sorted(shared)))}), {keys[0].name}) AS place FROM "
        f"(SELECT *, {owner} AS owner FROM (SELECT *, CASE{cases} END AS wrong FROM {table.name}{only}) AS checked "
        f"WHERE wrong IS NOT NULL) AS owned) AS placed WHERE place = 1 LIMIT {most}",
        {} if servo is None else {"servo": servo},
    )
    found = []
    for name, whose, *values in rows:
        row, column = dict(zip(columns, values, strict=True)), table.columns[name]
        clause = _clause(f"{table.name}.{name}", _kind(column), _content(column), row[column])
        of_servo = whose if isinstance(whose, str) and name not in shared else None
        found.append(WrongRow(of_servo, f"{clause}, in {row_name(keys, (row[key] for key in keys))}"))
    return found


def row_name(columns: Iterable[sa.Column[Any]], key: Iterable[Any]) -> str:
    """Name of a row by the columns of its key."""
    parts = (f"{column.name} {_shown(held)}" for column, held in zip(columns, key, strict=True))
    return f"the row of {', '.join(parts)}"


def _shown(value: Any) -> str:
    return "of bytes" if isinstance(value, bytes) else repr(value)[:80]


def _contents(columns: Iterable[sa.Column[Any]]) -> dict[str, str]:
    """Conditions for wrong contents by the names of those columns that have any."""
    return {each.name: content.sql(each.name) for each in columns if (content := _content(each)) is not None}


def _content(column: sa.Column[Any]) -> Content | None:
    return column.type.content if isinstance(column.type, StoredValue) else None


def _kind(column: sa.Column[Any]) -> type:
    return column.type.kind if isinstance(column.type, StoredValue) else column.type.python_type


def check_values(metadata: sa.MetaData, contents: Mapping[str, Content]) -> None:
    """Have all columns of some tables check their values; `contents`: of columns by name. Whole numbers are counts."""
    for table in metadata.tables.values():
        for column in table.columns:
            default = _COUNT if column.type.python_type is int else None
            content = contents.get(f"{table.name}.{column.name}", contents.get(column.name, default))
            column.type = StoredValue(column.type, f"{table.name}.{column.name}", content)


def _clause(column: str, kind: type, content: Content | None, value: Any) -> str:
    """Clause on a value that does not belong into its column, TABLE.COLUMN."""
    if content is not None and (type(value) is kind or (type(value) is int and kind is float)):
        return f"column {column} holds {_shown(value)} where {content.words} belongs"
    held, wanted = _NAMES.get(type(value), f"a value of type {type(value).__name__}"), _NAMES[kind]
    return f"column {column} holds {held} where {wanted} belong{'' if wanted == _BYTES else 's'}"
