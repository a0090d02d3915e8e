"""Addresses and connections: SQLite with one writer and a write-ahead log, PostgreSQL with a pool."""

from __future__ import annotations

import os
import socket
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from errno import EROFS
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock
from typing import Any
from weakref import WeakSet

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import ArgumentError, DataError, DBAPIError, IntegrityError, ProgrammingError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from servotwin.errors import InvalidInput, ResourceUnavailable
from servotwin.runtime import sqlite_damage
from servotwin.runtime.files import FilesInPlace
from servotwin.runtime.sqlite_damage import damage_words
from servotwin.store.pool import ClosingPool
from servotwin.store.stored_value import WrongValue

SQLITE, POSTGRESQL = "sqlite", "postgresql"
_ALLOWED = "give the name of a file, sqlite:///FILE or postgresql://USER@HOST/DATABASE"
_BUSY_S = 10.0
"""s that a connection waits for another one's transaction."""
_SERVER_TIMES = {
    "connect_timeout": "10",
    "keepalives_idle": "10",
    "keepalives_interval": "5",
    "keepalives_count": "3",
    "tcp_user_timeout": "25000",
}
"""libpq's limits, s and ms, unless the URL gives others: its own wait minutes where a network swallows packets."""
_LOCKED = "database is locked"
"""SQLite's words: they sound as if the operator had locked it."""
_PAUSE_S = 0.005
"""s between two attempts where SQLite itself does not wait."""
_PAGE_BYTES = 8192
_LOG_PAGES = 2000
"""Pages of the write-ahead log after which they are copied into the database: 16 MB."""
_READERS = 8
_CALLERS_FAULT = (IntegrityError, DataError, ProgrammingError)
"""Raised as they are: the statement is wrong, and repeating it does not help."""
_SQL_DAMAGE = ("XX001", "XX002")
_LOST_RACES = ("40001", "40P01")
"""SQLSTATE of a serialization failure and of a deadlock."""
_NOT_AS_MADE = ("3F000", "42P01", "42703", "42501", "42804", "42883", "2200H", "P0001")
"""SQLSTATE of a schema, table or column that is not there, of a right that was taken away, of a column of another type,
of numbers of rows that are used up, and of a trigger's own error: the driver counts them among faults of the statement,
but the same statements worked before."""
_OF_THE_SESSION = ("25006", "57014")
"""SQLSTATE of a write in a read-only transaction, and of a statement that took too long: a session keeps the limits of
its beginning for ever, though the database has other ones meanwhile."""


class StoreUnavailable(ResourceUnavailable):
    """The database cannot be read or written now: a full or read-only disk, a lost connection. One sentence."""


class StoreDamaged(StoreUnavailable):
    """Pages of the database are damaged. One sentence."""


class ServoSetAside(StoreUnavailable):
    """Rows of the servo are damaged: it is set aside, and the store works for all others. One sentence."""

    def __init__(self, servo: str) -> None:
        super().__init__(
            f"the twin's record of servo {servo!r} is damaged and set aside: its edge keeps its windows until that is "
            "put right"
        )
        self.servo = servo


class StoreBusy(RuntimeError):
    """Too many messages wait to be committed, so that no more are accepted. One sentence."""


def parse_address(url: str, password: str | None = None) -> sa.URL:
    """Parse an address; one without "://" is the name of an SQLite file. `password` replaces the one in it.

    Raises
    ------
    InvalidInput
        Neither SQLite nor PostgreSQL, or not an address. The message does not repeat the text: it may hold a password.
    """
    if "://" not in url:
        return sa.URL.create(SQLITE, database=url) if url else _refuse("is empty")
    try:
        address = sa.make_url(url)
    except (ArgumentError, ValueError):
        return _refuse("cannot be read")
    system = address.get_backend_name()
    if system == POSTGRESQL:
        return address.set(drivername="postgresql+psycopg", password=address.password if password is None else password)
    return address.set(drivername=SQLITE) if system == SQLITE else _refuse(f"names {system!r}")


def public_address(address: sa.URL) -> str:
    """Address for logs and messages, as an operator writes it: without driver, password and options."""
    system, user = address.get_backend_name(), address.username
    return sa.URL.create(system, user, None, address.host, address.port, address.database).render_as_string()


def sqlite_file(address: sa.URL) -> Path | None:
    """The file of an SQLite store; None: it is in memory, or no file."""
    database = address.database or ":memory:"
    return None if address.get_backend_name() != SQLITE or database == ":memory:" else Path(database)


def _refuse(fault: str) -> sa.URL:
    raise InvalidInput(f"the store's address {fault}; {_ALLOWED}")


class OpenConnections:
    """Connections to a PostgreSQL server that are not closed yet; used by all threads."""

    def __init__(self) -> None:
        # Without the lock a thread that connects during a cut would end it: a set must not grow while it is read.
        self._opened, self._lock = WeakSet[Any](), Lock()

    def add(self, connection: Any) -> None:
        """Note a new connection."""
        with self._lock:
            self._opened.add(connection)

    def cut(self) -> None:
        """Cut them all: calls that wait for an answer fail, and the next ones connect."""
        with self._lock:
            opened = tuple(self._opened)
        for connection in opened:
            # Closed meanwhile, perhaps, by the thread that has it.
            with suppress(Exception), socket.socket(fileno=os.dup(connection.fileno())) as line:
                line.shutdown(socket.SHUT_RDWR)


@dataclass(frozen=True)
class Engines:
    """Engines for writing and reading; SQLite has one writing connection, which serialises writers.

    Attributes
    ----------
    writer, reader : sa.Engine
    opened : OpenConnections
        None of an SQLite file.
    """

    writer: sa.Engine
    reader: sa.Engine
    opened: OpenConnections

    @property
    def distinct(self) -> tuple[sa.Engine, ...]:
        """Writer and reader; one where they are the same."""
        return (self.writer,) if self.writer is self.reader else (self.writer, self.reader)

    def dispose(self) -> None:
        """Close every connection that is not in use; one that is closes after its use."""
        for engine in self.distinct:
            engine.dispose()


def engines_of(address: sa.URL) -> Engines:
    """Make engines, which connect at their first use.

    Raises
    ------
    InvalidInput
        The driver of PostgreSQL is missing, or an SQLite file cannot be created, or is missing beside its log.
    """
    opened = OpenConnections()
    if address.get_backend_name() != SQLITE:
        engine = _postgresql(address, opened)
        return Engines(engine, engine, opened)
    path = sqlite_file(address)
    if path is None:
        writer = _sqlite(address, 1, reading=False)
        return Engines(writer, writer, opened)
    _make_private(path)
    return Engines(_sqlite(address, 1, reading=False), _sqlite(address, _READERS, reading=True), opened)


@contextmanager
def transaction(engine: sa.Engine) -> Iterator[sa.Connection]:
    """Run a block in a transaction, which is committed unless the block raises.

    Raises
    ------
    StoreUnavailable
        The database is not available now.
    """
    try:
        with engine.begin() as connection, _session_ended(connection):
            yield connection
    except DBAPIError as error:
        if isinstance(error, _CALLERS_FAULT) and _is_of_the_statement(error):
            raise
        if is_damage(error.orig):
            raise StoreDamaged(
                f"store {public_address(engine.url)}: is damaged ({damage_words(error.orig)})"
            ) from error.orig
        raise _unavailable(engine, str(error.orig)) from error.orig
    except WrongValue as error:
        raise StoreDamaged(f"store {public_address(engine.url)}: is damaged ({error})") from error
    except (PoolTimeout, sqlite3.Error) as error:
        raise _unavailable(engine, str(error)) from None


@contextmanager
def _session_ended(connection: sa.Connection) -> Iterator[None]:
    """End a session whose own limits made a block fail: the next transaction begins another one."""
    try:
        yield
    except DBAPIError as error:
        if getattr(error.orig, "sqlstate", None) in _OF_THE_SESSION:
            connection.invalidate(error)
        raise


def lost_race(error: StoreUnavailable) -> bool:
    """Test whether PostgreSQL rolled a transaction back only because of a concurrent one: retry it at once."""
    return getattr(error.__cause__, "sqlstate", None) in _LOST_RACES


def is_damage(error: BaseException | None) -> bool:
    """Test for the errors of SQLite and PostgreSQL that name damage; of the latter: data or index corrupted."""
    return sqlite_damage.is_damage(error) or getattr(error, "sqlstate", None) in _SQL_DAMAGE


def _is_of_the_statement(error: DBAPIError) -> bool:
    """Tell a wrong statement from an address with an unknown option, and from a store that is not as it was made."""
    return error.statement is not None and getattr(error.orig, "sqlstate", None) not in _NOT_AS_MADE


def _unavailable(engine: sa.Engine, message: str) -> StoreUnavailable:
    reason = message.strip().splitlines()[0] if message.strip() else "no reason given"
    if reason == _LOCKED:
        reason = f"another program has kept it locked for {_BUSY_S:g} s"
    return StoreUnavailable(
        f"store {public_address(engine.url)}: not available now ({reason}{_why_not_written(engine)})"
    )


def _why_not_written(engine: sa.Engine) -> str:
    """Reason for which nothing can be written beside an SQLite file, which SQLite itself calls an error of the disk."""
    file = sqlite_file(engine.url)
    if file is None:
        return ""
    try:
        with TemporaryFile(dir=file.parent):
            return _closed_files(file)
    except OSError as error:
        if error.errno == EROFS:
            return f"; the file system of {file.parent} is read-only"
        return _closed_files(file)


def _closed_files(file: Path) -> str:
    """Names of the files that this user may not write: SQLite tells neither that nor which; a log keeps its mode."""
    places = [file.parent, *(file.with_name(f"{file.name}{end}") for end in ("", "-wal", "-shm"))]
    closed = [str(place) for place in places if os.access(place, os.F_OK) and not os.access(place, os.W_OK)]
    return f"; this user may not write {' and '.join(closed)}" if closed else ""


def _postgresql(address: sa.URL, opened: OpenConnections) -> sa.Engine:
    times = {name: value for name, value in _SERVER_TIMES.items() if name not in address.query}
    try:
        engine = sa.create_engine(
            address,
            hide_parameters=True,
            poolclass=ClosingPool,
            pool_size=_READERS,
            max_overflow=_READERS,
            connect_args=times,
        )
    except ModuleNotFoundError:
        raise InvalidInput(
            f"store {public_address(address)}: PostgreSQL needs the package psycopg; install servotwin[postgres]"
        ) from None

    @event.listens_for(engine, "connect")
    def limit_locks(connection: Any, _record: Any) -> None:
        opened.add(connection)
        # PostgreSQL itself waits for a lock for ever: VACUUM FULL, or a session that somebody forgot, would go unsaid.
        connection.execute(f"SET lock_timeout = {round(1000.0 * _BUSY_S)}")
        # A twin that is stopped in a transaction keeps its locks: the server ends that before others give up waiting.
        connection.execute(f"SET idle_in_transaction_session_timeout = {round(500.0 * _BUSY_S)}")
        connection.commit()

    return engine


def _sqlite(address: sa.URL, connections: int, *, reading: bool) -> sa.Engine:
    engine = sa.create_engine(
        address,
        hide_parameters=True,
        # No overflow: one writing connection is what serialises the writers of SQLite.
        poolclass=ClosingPool,
        pool_size=connections,
        max_overflow=0,
        pool_timeout=_BUSY_S,
        connect_args={"timeout": _BUSY_S, "check_same_thread": False},
    )
    # IMMEDIATE takes the write lock at once: a transaction that reads first could not be upgraded and would fail.
    begin = "BEGIN" if reading else "BEGIN IMMEDIATE"

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _record: Any) -> None:
        # The driver would begin transactions itself, and late; `begin_transaction` does it.
        connection.isolation_level = None
        for pragma in _pragmas(reading):
            _set_pragma(connection, pragma)

    @event.listens_for(engine, "begin")
    def begin_transaction(connection: sa.Connection) -> None:
        connection.exec_driver_sql(begin)
        if not reading:
            _check_files(connection)

    return engine


def _check_files(connection: sa.Connection) -> None:
    """Refuse to write to files that are open and no longer in their places: they are gone once this process ends.

    Raises
    ------
    StoreDamaged
        The file, or its log, was deleted, moved or replaced since the connection first wrote.
    """
    file = sqlite_file(connection.engine.url)
    if file is None:
        return
    if "files" not in connection.info:
        connection.info["files"] = FilesInPlace((file, file.with_name(f"{file.name}-wal")))
    changed = [place.name for place in connection.info["files"].changed()]
    if changed:
        raise StoreDamaged(
            f"store {public_address(connection.engine.url)}: is damaged ({' and '.join(changed)}: deleted, moved or "
            "replaced while the store was open)"
        )


def _set_pragma(connection: Any, pragma: str) -> None:
    """Set a pragma; wait where others open the file too: SQLite does not wait where two would switch to a log."""
    patience = time.monotonic() + _BUSY_S
    while True:
        try:
            connection.execute(f"PRAGMA {pragma}")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > patience:
                raise
        time.sleep(_PAUSE_S)


def _pragmas(reading: bool) -> tuple[str, ...]:
    common = ("foreign_keys = ON", "temp_store = MEMORY")
    if reading:
        return (*common, "query_only = ON")
    layout = (f"page_size = {_PAGE_BYTES}", "auto_vacuum = INCREMENTAL", "journal_mode = WAL")
    # FULL: a commit is synced to the disk, so that an acknowledged message survives a power failure.
    safety = ("synchronous = FULL", f"wal_autocheckpoint = {_LOG_PAGES}", "journal_size_limit = 67108864")
    return (*layout, *safety, *common)


def _make_private(path: Path) -> None:
    """Create the file readable by its owner only; SQLite gives its log the same mode."""
    log = path.with_name(f"{path.name}-wal")
    if log.exists() and not path.exists():  # in this order: another process may be creating both
        raise InvalidInput(
            f"store {path}: is missing, but its log {log.name} exists, which a new store would delete; move the store "
            "back beside it, or the log away"
        )
    try:
        # With its mode from the start: between creation and a chmod others could open it.
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    except FileExistsError:
        return
    except OSError as error:
        raise InvalidInput(f"store {path}: cannot be created ({error.strerror})") from None
