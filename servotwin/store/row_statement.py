"""Statements that are run for many rows, compiled once.

SQLAlchemy binds each value of each row anew, which takes longer for a row than SQLite takes to run the statement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import sqlalchemy as sa

Row = Mapping[str, Any]


class RowStatement:
    """An insert or an update that is run for each of some rows.

    Parameters
    ----------
    make : callable
        Name of a dialect -> statement; called once for each database.
    columns : sequence of str
        Columns of an insert; none for an update, which names its parameters.
    """

    def __init__(self, make: Callable[[str], sa.Insert | sa.Update], columns: Iterable[str] = ()) -> None:
        names = list(columns)
        self._compiled = lru_cache(maxsize=8)(lambda dialect: _compile(make(dialect.name), dialect, names))

    def run(self, connection: sa.Connection, rows: Iterable[Row]) -> int:
        """Run it for each row, where there is one; returns the number of rows that were written."""
        given = list(rows)
        if not given:
            return 0
        text, order, constants = self._compiled(connection.dialect)
        bound: list[Any] = [{**constants, **row} for row in given]
        if order is not None:
            bound = [tuple(map(row.__getitem__, order)) for row in bound]
        return connection.exec_driver_sql(text, bound).rowcount


class _Compiled(NamedTuple):
    """Text for the driver; names of its values where it takes them by place; values that are the same for each row."""

    text: str
    order: list[str] | None
    constants: dict[str, Any]


def _compile(statement: sa.Insert | sa.Update, dialect: sa.Dialect, columns: list[str]) -> _Compiled:
    compiled = statement.compile(dialect=dialect, column_keys=columns or None)
    constants = {name: bind.value for name, bind in compiled.binds.items() if not bind.required}
    return _Compiled(compiled.string, compiled.positiontup, constants)
