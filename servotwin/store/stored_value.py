"""Types of the columns, which check each value that is read: SQLite keeps a value of any type in any column."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa

_BYTES = "bytes"
_NAMES = {float: "a number", int: "a whole number", str: "a text", bytes: _BYTES}
_SQLITE_NAMES = {"real": "a number", "integer": "a whole number", "text": "a text", "blob": _BYTES}
_STORED = {
    float: "('real', 'integer', 'null')",
    int: "('integer', 'null')",
    str: "('text', 'null')",
    bytes: "('blob', 'null')",
}
"""Types of SQLite's values that belong into columns of Python's."""


class WrongType(Exception):
    """A value of another type than its column's was read. One clause."""


class StoredValue(sa.TypeDecorator[Any]):
    """Type of a column that refuses to give a value of another type, since whoever computed with it would fail.

    Parameters
    ----------
    type_ : TypeEngine
        Type of the column.
    column : str
        TABLE.COLUMN.
    """

    impl: sa.types.TypeEngine[Any] | type[sa.types.TypeEngine[Any]] = sa.types.NullType
    cache_ok = True

    def __init__(self, type_: sa.types.TypeEngine[Any], column: str) -> None:
        super().__init__()
        self.impl = type_
        self.column = column

    @property
    def kind(self) -> type:
        """Python's type of the values."""
        return self.impl_instance.python_type

    def result_processor(self, _dialect: sa.Dialect, _coltype: object) -> Callable[[Any], Any]:
        """Return the check; the drivers of both systems give Python's own types."""
        kind, column = self.kind, self.column
        wanted = (float, int) if kind is float else (kind,)

        def check(value: Any) -> Any:
            if value is None or type(value) in wanted:
                return value
            held = _NAMES.get(type(value), f"a value of type {type(value).__name__}")
            raise WrongType(wrong_type(column, held, _NAMES[kind]))

        return check


def wrong_value(connection: sqlite3.Connection, table: sa.Table) -> str:
    """First value of another type in a table of an SQLite file, of any revision, in a clause; empty: there is none."""
    known = {row[1] for row in connection.execute(f"PRAGMA table_info('{table.name}')")}
    columns = [column for column in table.columns if column.name in known]
    if not columns:  # an earlier revision lacks some tables
        return ""
    cases = "".join(f" WHEN typeof({c.name}) NOT IN {_STORED[_kind(c)]} THEN '{c.name}'" for c in columns)
    types = "".join(f" WHEN '{c.name}' THEN typeof({c.name})" for c in columns)
    found = connection.execute(
        f"SELECT wrong, CASE wrong{types} END FROM (SELECT *, CASE{cases} END AS wrong FROM {table.name}) "
        "WHERE wrong IS NOT NULL LIMIT 1"
    ).fetchone()
    if found is None:
        return ""
    name, held = found
    return wrong_type(f"{table.name}.{name}", _SQLITE_NAMES[held], _NAMES[_kind(table.columns[name])])


def _kind(column: sa.Column[Any]) -> type:
    return column.type.kind if isinstance(column.type, StoredValue) else column.type.python_type


def check_values(metadata: sa.MetaData) -> None:
    """Have all columns of some tables check their values."""
    for table in metadata.tables.values():
        for column in table.columns:
            column.type = StoredValue(column.type, f"{table.name}.{column.name}")


def wrong_type(column: str, held: str, wanted: str) -> str:
    """Clause on a column, TABLE.COLUMN, with a value of another type."""
    return f"column {column} holds {held} where {wanted} belong{'' if wanted == _BYTES else 's'}"
