"""Check of a PostgreSQL store's tables: the server reports a page that is damaged, but not rows that are gone."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import sqlalchemy as sa

from servotwin.store.engine import StoreDamaged, StoreUnavailable, transaction
from servotwin.store.schema import metadata
from servotwin.store.stored_value import WrongRow, wrong_contents

_BY_INDEX = ("enable_indexscan", "enable_indexonlyscan")
_BY_TABLE = ("enable_seqscan", "enable_sort")
_BITMAP = "enable_bitmapscan"
"""Plans that read an index in its order, plans that read the table in its own, and one that reads both."""
_SOUGHT_PERCENT = 5.0
"""Share of the rows that are sought by each index in a bounded time: a page above its leaves leads to thousands."""
_COLUMNS = sa.text(
    "SELECT table_name, column_name, data_type FROM information_schema.columns WHERE table_schema = current_schema()"
)
_CANCELED = "57014"
_LEAST_MS = 1


def table_faults(engine: sa.Engine, seconds: float, most: int) -> tuple[tuple[str, ...], bool, list[WrongRow]]:
    """Read all rows and indexes, look for rows that refer to rows which are gone, and count both; for a bounded time.

    A page of zeros is an empty page to PostgreSQL, with checksums too: the rows of such a page are gone unsaid. An
    index still has them, and counts them where a vacuum has noted that all of the page's rows are visible.

    Returns
    -------
    tuple of str, bool, list of WrongRow
        Faults, True where everything was checked, and rows with wrong values, of `most` servos in each table.

    Raises
    ------
    StoreUnavailable
        The server does not answer.
    """
    until = time.monotonic() + seconds
    try:
        # One snapshot: rows that come meanwhile would be in the index, and not in the table that was counted before.
        with transaction(engine.execution_options(isolation_level="REPEATABLE READ")) as connection:
            known = set(sa.inspect(connection).get_table_names())
            missing = tuple(f"table {name}: is missing" for name in metadata.tables if name not in known)
            faults = missing or _wrong_columns(connection)
            if faults:
                return faults, True, []
            wrong = [row for table in metadata.sorted_tables for row in wrong_contents(connection, table, most)]
            return _lost_references(connection, until) or _lost_rows(connection, until), True, wrong
    except StoreDamaged as error:
        return (str(error),), False, []
    except StoreUnavailable as error:
        if getattr(error.__cause__, "sqlstate", None) != _CANCELED:
            raise
        return (), False, []


def _wrong_columns(connection: sa.Connection) -> tuple[str, ...]:
    """Columns of another type: comparing and computing with their values fails, or means something else."""
    found = connection.execute(_COLUMNS)
    types = {(row.table_name, row.column_name): row.data_type for row in found}
    faults = []
    for table in metadata.sorted_tables:
        for column in table.columns:
            made = column.type.compile(connection.dialect).lower()
            there = types.get((table.name, column.name), made)
            if there != made:
                faults.append(f"column {table.name}.{column.name} is of type {there}, and was made as {made}")
    return tuple(faults)


def _lost_references(connection: sa.Connection, until: float) -> tuple[str, ...]:
    _read_by_table(connection, True)
    faults = []
    for table in metadata.sorted_tables:
        _limit(connection, until)
        connection.execute(sa.select(sa.func.count()).select_from(table))
        for key in sorted(table.foreign_keys, key=lambda key: key.target_fullname):
            _limit(connection, until)
            if lost := connection.execute(_without_target(key)).scalar_one():
                faults.append(
                    f"table {key.column.table.name}: {lost} rows of table {table.name} refer to rows that are gone"
                )
    return tuple(faults)


def _lost_rows(connection: sa.Connection, until: float) -> tuple[str, ...]:
    """Count the rows by table and by each index, which reads its leaves; seek them, which reads the pages above."""
    faults = []
    for index in _indexes():
        counts = []
        for by_table in (True, False):
            _read_by_table(connection, by_table)
            _limit(connection, until)
            counts.append(connection.execute(_count(index)).scalar_one())
        for seek in _seeks(index, 100.0 if math.isinf(until) else _SOUGHT_PERCENT):
            _limit(connection, until)
            connection.execute(seek)
        if counts[0] != counts[1]:
            faults.append(f"table {index.table.name}: {counts[0]} rows, and {counts[1]} in its index {index.name}")
    return tuple(faults)


class _Index(NamedTuple):
    name: Any
    table: sa.Table
    columns: list[sa.Column[Any]]
    where: Any = None


def _indexes() -> Iterator[_Index]:
    for table in metadata.sorted_tables:
        for each in table.constraints:
            if isinstance(each, sa.PrimaryKeyConstraint | sa.UniqueConstraint):
                yield _Index(each.name, table, list(each.columns))
        for index in table.indexes:
            yield _Index(index.name, table, list(index.columns), index.dialect_options["postgresql"]["where"])


def _count(index: _Index) -> sa.Select[Any]:
    """Number of an index's rows, in its order; without the offset PostgreSQL would count them in any."""
    rows: sa.Select[Any] = sa.select(sa.literal_column("1")).select_from(index.table).order_by(*index.columns).offset(0)
    rows = rows if index.where is None else rows.where(index.where)
    return sa.select(sa.func.count()).select_from(rows.subquery())


def _seeks(index: _Index, percent: float) -> Iterator[sa.Select[Any]]:
    """Seek a share of an index's rows from its root: to read it in its order visits the leftmost pages above leaves.

    Rows with null in a column are sought apart: null compares with nothing, so that each would read all that are alike
    in the columns before it, as all estimates of a servo.
    """
    yield _seek(index, percent, len(index.columns))
    for place, column in enumerate(index.columns[:-1]):
        if column.nullable:
            yield _seek(index, percent, place)


def _seek(index: _Index, percent: float, null: int) -> sa.Select[Any]:
    """Seek rows with null in the column at the place `null`, or, where there is no such column, in none.

    Only this index gives its order, so that no plan can use another.
    """
    sample = index.table.tablesample(sa.func.bernoulli(percent), name="sample")
    sought = [sample.c[column.name] for column in index.columns]
    if null == len(sought):
        conditions = [sa.tuple_(*index.columns) >= sa.tuple_(*sought)]
    else:
        conditions = [column == value for column, value in zip(index.columns[:null], sought, strict=False)]
        conditions += [
            index.columns[null].is_(None),
            sa.tuple_(*index.columns[null + 1 :]) >= sa.tuple_(*sought[null + 1 :]),
        ]
    first: sa.Select[Any] = sa.select(sa.literal_column("1").label("found")).select_from(index.table).where(*conditions)
    first = first if index.where is None else first.where(index.where)
    found = first.order_by(*index.columns).limit(1).correlate(sample).lateral()
    kept = (value.is_(None) if place == null else value.is_not(None) for place, value in enumerate(sought))
    return sa.select(sa.func.count()).select_from(sample.join(found, sa.true())).where(*kept)


def _read_by_table(connection: sa.Connection, by_table: bool) -> None:
    """Have the server read tables themselves, or else in the order of an index."""
    for names, on in ((_BY_TABLE, by_table), (_BY_INDEX, not by_table), ((_BITMAP,), False)):
        for name in names:
            _set(connection, name, "on" if on else "off")


def _without_target(key: sa.ForeignKey) -> sa.Select[Any]:
    """Number of the rows that refer to no row."""
    target = key.column.table.alias()
    there = sa.exists().where(target.c[key.column.name] == key.parent)
    return sa.select(sa.func.count()).select_from(key.parent.table).where(key.parent.is_not(None), ~there)


def _limit(connection: sa.Connection, until: float) -> None:
    """Have the server cancel a statement that takes longer than until then."""
    left = until - time.monotonic()
    _set(connection, "statement_timeout", str(0 if math.isinf(left) else max(_LEAST_MS, round(1000.0 * left))))


def _set(connection: sa.Connection, name: str, value: str) -> None:
    """Set one of the server's parameters until the transaction ends."""
    connection.execute(sa.select(sa.func.set_config(name, value, True)))
