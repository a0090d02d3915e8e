"""Where a store is: a file or a PostgreSQL database, shown without what must not be seen."""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError

from servotwin.errors import InvalidInput

SQLITE, POSTGRESQL = "sqlite", "postgresql"
_ALLOWED = "give the name of a file, sqlite:///FILE or postgresql://USER@HOST/DATABASE"


def address_of(url: str, password: str | None = None) -> sa.URL:
    """The address in a text; one without "://" is the name of an SQLite file. `password` replaces the one in it.

    Raises
    ------
    InvalidInput
        Neither SQLite nor PostgreSQL, or no address at all. The text is not repeated: it may hold a password.
    """
    if "://" not in url:
        return sa.URL.create(SQLITE, database=url) if url else _refuse("is empty")
    try:
        found = sa.make_url(url)
    except (ArgumentError, ValueError):
        return _refuse("cannot be read")
    system = found.get_backend_name()
    if system == POSTGRESQL:
        return found.set(drivername="postgresql+psycopg", password=found.password if password is None else password)
    return found.set(drivername=SQLITE) if system == SQLITE else _refuse(f"names {system!r}")


def shown(address: sa.URL) -> str:
    """The address for people: without password and without options, which may hold one too."""
    return address.set(password=None, query={}).render_as_string()


def file_of(address: sa.URL) -> Path | None:
    """The file of an SQLite store; None: it is in memory, or no file."""
    database = address.database or ":memory:"
    return None if address.get_backend_name() != SQLITE or database == ":memory:" else Path(database)


def _refuse(fault: str) -> sa.URL:
    raise InvalidInput(f"the store's address {fault}; {_ALLOWED}")
