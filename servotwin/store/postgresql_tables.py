"""Check of a PostgreSQL store's tables: the server reports a page that is damaged, but not rows that are gone."""

from __future__ import annotations

import math
import time
from typing import Any

import sqlalchemy as sa

from servotwin.store.engine import StoreDamaged, StoreUnavailable, transaction
from servotwin.store.schema import metadata

_BY_TABLE = ("enable_indexscan", "enable_indexonlyscan", "enable_bitmapscan")
"""Plans that would read an index in place of the table."""
_CANCELED = "57014"
_LEAST_MS = 1


def table_faults(engine: sa.Engine, seconds: float) -> tuple[tuple[str, ...], bool]:
    """Read every row of every table, and look for rows that refer to rows which are gone; for a bounded time.

    A page of zeros is an empty page to PostgreSQL, with checksums too: the rows of such a page are gone unsaid.

    Returns
    -------
    tuple of str, bool
        Faults, and True where everything was checked.

    Raises
    ------
    StoreUnavailable
        The server does not answer.
    """
    until = time.monotonic() + seconds
    try:
        with transaction(engine) as connection:
            known = set(sa.inspect(connection).get_table_names())
            missing = tuple(f"table {name}: is missing" for name in metadata.tables if name not in known)
            return missing or _lost_references(connection, until), True
    except StoreDamaged as error:
        return (str(error),), False
    except StoreUnavailable as error:
        if getattr(error.__cause__, "sqlstate", None) != _CANCELED:
            raise
        return (), False


def _lost_references(connection: sa.Connection, until: float) -> tuple[str, ...]:
    for name in _BY_TABLE:
        _set(connection, name, "off")
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
