"""Connections: SQLite with one writer and a write-ahead log, PostgreSQL with a pool."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError, ProgrammingError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.pool import QueuePool

from servotwin.errors import InvalidInput
from servotwin.store.address import SQLITE, file_of, shown
from servotwin.store.errors import StoreUnavailable

BUSY_S = 10.0
_PAGE_BYTES = 8192
_LOG_PAGES = 2000
_READERS = 8
_OURS = (IntegrityError, DataError, ProgrammingError)
_LOST_RACES = ("40001", "40P01")


class Engines(NamedTuple):
    """Where transactions begin; of SQLite's writer there is one connection, so writers wait in line for it."""

    writer: sa.Engine
    reader: sa.Engine

    def dispose(self) -> None:
        """Close every connection."""
        self.reader.dispose()
        self.writer.dispose()


def engines_of(address: sa.URL) -> Engines:
    """Engines that connect when they are first used.

    Raises
    ------
    InvalidInput
        The driver of PostgreSQL is missing, or an SQLite file cannot be made.
    """
    if address.get_backend_name() != SQLITE:
        engine = _postgresql(address)
        return Engines(engine, engine)
    path = file_of(address)
    if path is None:
        writer = _sqlite(address, 1, reading=False)
        return Engines(writer, writer)
    _make_private(path)
    return Engines(_sqlite(address, 1, reading=False), _sqlite(address, _READERS, reading=True))


@contextmanager
def transaction(engine: sa.Engine) -> Iterator[sa.Connection]:
    """A transaction, committed when the block ends well.

    Raises
    ------
    StoreUnavailable
        The database cannot do it now.
    """
    try:
        with engine.begin() as connection:
            yield connection
    except _OURS:
        raise
    except DBAPIError as error:
        raise _unavailable(engine, str(error.orig)) from error.orig
    except (PoolTimeout, sqlite3.Error) as error:
        raise _unavailable(engine, str(error)) from None


def lost_race(error: StoreUnavailable) -> bool:
    """Whether PostgreSQL undid a transaction only for meeting another one: it may be tried again at once."""
    return getattr(error.__cause__, "sqlstate", None) in _LOST_RACES


def _unavailable(engine: sa.Engine, said: str) -> StoreUnavailable:
    reason = said.strip().splitlines()[0] if said.strip() else "no reason given"
    return StoreUnavailable(f"store {shown(engine.url)}: not available now ({reason})")


def _postgresql(address: sa.URL) -> sa.Engine:
    try:
        return sa.create_engine(address, hide_parameters=True, pool_size=_READERS, max_overflow=_READERS)
    except ModuleNotFoundError:
        raise InvalidInput(
            f"store {shown(address)}: PostgreSQL needs the package psycopg; install servotwin[postgres]"
        ) from None


def _sqlite(address: sa.URL, connections: int, *, reading: bool) -> sa.Engine:
    engine = sa.create_engine(
        address,
        hide_parameters=True,
        poolclass=QueuePool,
        pool_size=connections,
        max_overflow=0,
        pool_timeout=BUSY_S,
        connect_args={"timeout": BUSY_S, "check_same_thread": False},
    )
    begin = "BEGIN" if reading else "BEGIN IMMEDIATE"

    @event.listens_for(engine, "connect")
    def connected(connection: Any, _record: Any) -> None:
        connection.isolation_level = None
        for pragma in _pragmas(reading):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def begun(connection: sa.Connection) -> None:
        connection.exec_driver_sql(begin)

    return engine


def _pragmas(reading: bool) -> tuple[str, ...]:
    common = ("foreign_keys = ON", "temp_store = MEMORY")
    if reading:
        return (*common, "query_only = ON")
    layout = (f"page_size = {_PAGE_BYTES}", "auto_vacuum = INCREMENTAL", "journal_mode = WAL")
    safety = ("synchronous = FULL", f"wal_autocheckpoint = {_LOG_PAGES}", "journal_size_limit = 67108864")
    return (*layout, *safety, *common)


def _make_private(path: Path) -> None:
    """A new file that only its owner may read: the log beside it takes over its mode."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    except FileExistsError:
        return
    except OSError as error:
        raise InvalidInput(f"store {path}: cannot be made ({error.strerror})") from None
