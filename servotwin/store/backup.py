"""An SQLite store copied to a file while it is written to, and put back; PostgreSQL has tools of its own for that."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

import sqlalchemy as sa

from servotwin.errors import InvalidInput
from servotwin.runtime.files import atomic_output
from servotwin.store.address import POSTGRESQL, address_of, file_of, shown
from servotwin.store.migrate import VERSIONS
from servotwin.store.schema import REVISION, metadata

PAGES = 2048
"""Pages that are copied between two reports."""
PRIVATE = 0o600
SINCE = 1_000_000
"""Messages to one edge that may have been posted since a backup."""

Progress = Callable[[int, int], None]
"""(pages that remain, pages in all)."""


class Counts(NamedTuple):
    """Rows of a store."""

    twins: int
    messages: int
    bodies: int
    evidence: int
    outgoing: int


def backup(url: str, to: Path, progress: Progress | None = None) -> Counts:
    """Copy a store as it is at one moment into a new file; whoever writes to it goes on.

    The file is checked before it gets its name: it is whole or not there. Only its owner may read it.

    Parameters
    ----------
    url : str
        Of an SQLite store; of PostgreSQL's the error says what to call.
    to : Path
        Replaced if it exists.

    Returns
    -------
    Counts
        What the file holds.

    Raises
    ------
    InvalidInput
        No store there, one of PostgreSQL, or the file cannot be written.
    """
    source = _sqlite_file(url, "pg_dump --format=custom --file={} DATABASE", to)
    if not source.is_file():
        raise InvalidInput(f"store {source}: there is no such file; give that of a store")
    if to.exists() and to.samefile(source):
        raise InvalidInput(f"backup {to}: is the store itself; give another file")
    with atomic_output(to, PRIVATE) as temporary:
        return _copied(source, temporary, progress)


def restore(backed_up: Path, url: str, progress: Progress | None = None) -> Counts:
    """Put a backup in the place of a store that does not exist or holds nothing.

    What was posted since the backup is lost, but edges have it: they ignore serials up to the last that they got. So
    numbers go on far beyond those in the backup.

    Raises
    ------
    InvalidInput
        The backup is damaged or of a newer servotwin; the store holds something, is in use, or is one of PostgreSQL.
    """
    place = _sqlite_file(url, "pg_restore --dbname=DATABASE {}", backed_up)
    if not backed_up.is_file():
        raise InvalidInput(f"backup {backed_up}: there is no such file")
    _check_free(place)
    with atomic_output(place, PRIVATE) as temporary:
        counts = _copied(backed_up, temporary, progress)
        with _opened(temporary, "mode=rw") as store:
            store.execute("UPDATE twins SET posted = posted + ?", (SINCE,))
        return counts


def _sqlite_file(url: str, instead: str, file: Path) -> Path:
    address = address_of(url)
    path = file_of(address)
    if path is not None:
        return path
    if address.get_backend_name() == POSTGRESQL:
        raise InvalidInput(f"store {shown(address)}: is PostgreSQL's; call {instead.format(file)}")
    raise InvalidInput(f"store {shown(address)}: is in memory; give that of a file")


def _copied(source: Path, target: Path, progress: Progress | None) -> Counts:
    """One moment of the source in the target, compared and checked."""
    with _opened(source, "mode=ro") as there, _opened(target, "mode=rw") as here:
        # The first read fixes the moment: later writes go to the log behind it.
        there.execute("BEGIN")
        _check_revision(there, source)
        expected = _counts(there)
        there.backup(here, pages=PAGES, progress=None if progress is None else lambda _, left, of: progress(left, of))
        there.execute("ROLLBACK")
        # The copy is one file then, without a log beside it.
        here.execute("PRAGMA journal_mode = DELETE")
        found = [row[0] for row in here.execute("PRAGMA integrity_check(1)")]
        if found != ["ok"]:
            raise InvalidInput(f"store {source}: is damaged ({found[0]}); restore an earlier backup")
        if _counts(here) != expected:
            raise InvalidInput(f"store {source}: its copy does not hold the same rows; try again")
        return expected


@contextmanager
def _opened(path: Path, mode: str) -> Iterator[sqlite3.Connection]:
    """A connection; what SQLite has to complain of becomes InvalidInput."""
    try:
        uri = f"{path.absolute().as_uri()}?{mode}"
        with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
            yield connection
    except sqlite3.Error as error:
        raise InvalidInput(f"store {path}: cannot be read or written ({error})") from None


def _check_revision(connection: sqlite3.Connection, path: Path) -> None:
    if not _tables(connection) >= {VERSIONS, *metadata.tables}:
        raise InvalidInput(f"store {path}: is not one of servotwin's")
    (revision,) = connection.execute(f"SELECT version_num FROM {VERSIONS}").fetchone()
    if revision > REVISION:
        raise InvalidInput(f"store {path}: its schema {revision} is newer than {REVISION}, the newest known here")


def _check_free(place: Path) -> None:
    """Nothing is lost when a file gets this name."""
    if not place.exists():
        log = place.with_name(f"{place.name}-wal")
        if log.exists():
            raise InvalidInput(f"store {place}: is gone, but its log {log.name} is there; move that away first")
        return
    with _opened(place, "mode=rw") as connection:
        if any(_rows(connection, table) for table in _tables(connection) - {VERSIONS}):
            raise InvalidInput(f"store {place}: holds something already; restore into a new one")
        connection.execute("PRAGMA busy_timeout = 0")
        try:
            # Only who is alone with a database may take its log away.
            connection.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.OperationalError:
            raise InvalidInput(f"store {place}: is in use; end its twin first") from None


def _tables(connection: sqlite3.Connection) -> set[str]:
    names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
    return {name for (name,) in names}


def _counts(connection: sqlite3.Connection) -> Counts:
    return Counts(*(_rows(connection, table) for table in Counts._fields))


def _rows(connection: sqlite3.Connection, table: str) -> int:
    query = sa.select(sa.func.count()).select_from(sa.table(table))
    (rows,) = connection.execute(str(query)).fetchone()
    return int(rows)
