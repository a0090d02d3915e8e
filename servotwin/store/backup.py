"""Backup and restore of an SQLite store, while it is in use; PostgreSQL has its own tools."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import sqlalchemy as sa

from servotwin.config.named_file import check_named
from servotwin.errors import InvalidInput
from servotwin.messages import Resend, encode
from servotwin.runtime.files import atomic_output
from servotwin.runtime.sqlite_damage import damage_words
from servotwin.store.claims import LOST_ANSWERS, alarm_row
from servotwin.store.engine import (
    POSTGRESQL,
    SQLITE,
    StoreUnavailable,
    engines_of,
    is_damage,
    parse_address,
    public_address,
    sqlite_file,
)
from servotwin.store.integrity import STORED_BODIES, body_fault
from servotwin.store.migrate import VERSIONS, checked_revision, migrate
from servotwin.store.outgoing import fresh_serial
from servotwin.store.schema import REVISION, metadata, set_aside
from servotwin.store.stored_value import WrongValue, wrong_value

PAGES = 2048
"""Pages copied between two progress reports."""
PRIVATE = 0o600
_SERIAL_MARGIN = 1_000_000
"""Upper bound of the messages to one edge that may have been posted since a backup."""
_OF_READING = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_IOERR_READ, sqlite3.SQLITE_IOERR_SHORT_READ)
"""Errors of a copy that are of its source, as damage is: only there may another process be at work."""

_ADD_ALARM = (
    "INSERT INTO evidence (servo, kind, status, created, body) VALUES (:servo, :kind, :status, :created, :body)"
)

Progress = Callable[[int, int], None]
"""(pages that remain, pages in all)."""


class RowCounts(NamedTuple):
    """Numbers of rows in a store's tables."""

    twins: int
    messages: int
    bodies: int
    evidence: int
    outgoing: int


class CopiedStore(NamedTuple):
    """Contents of a copy.

    Attributes
    ----------
    rows : RowCounts
    left_out : dict of str to str
        Servos that are set aside, of which it holds nothing, each with a clause on the reason.
    """

    rows: RowCounts
    left_out: dict[str, str]


def backup(url: str, to: Path, progress: Progress | None = None, replace: bool = False) -> CopiedStore:
    """Copy a store as of one moment into a new file; writers continue meanwhile.

    The copy is verified before it gets its name: it is complete or absent, but for servos that are set aside, which it
    names, so that `restore` can tell. Such a copy never replaces another one. Only its owner may read it.

    Parameters
    ----------
    url : str
        Of an SQLite store; for PostgreSQL the error names the command to use.
    to : Path
    progress : callable, optional
    replace : bool
        Allow `to` to exist: an emptied store must not take the place of its last good backup unasked.

    Returns
    -------
    CopiedStore

    Raises
    ------
    InvalidInput
        There is no store, it is damaged or in PostgreSQL, or the file exists or cannot be written; or it exists, and
        servos are set aside.
    """
    source = _existing(url, to)
    if to.exists() and to.samefile(source):
        raise InvalidInput(f"backup {to}: is the store itself; give another file")
    if to.exists() and not replace:
        raise InvalidInput(f"backup {to}: exists already; give another file, or --replace to replace it")
    with atomic_output(to, PRIVATE) as temporary:
        copied = _copied(source, temporary, to, progress)
        if copied.left_out and to.exists():
            raise InvalidInput(
                f"backup {to}: is not replaced, because the new one would lack servos that are set aside "
                f"({clauses(copied.left_out)}); give another file"
            )
        return copied


def clauses(left_out: Mapping[str, str]) -> str:
    """Servos that are set aside, and why."""
    return "; ".join(f"{servo}: {why}" for servo, why in left_out.items())


def newest_of(url: str, to: Path) -> int:
    """Id of the newest message of a store that is to be copied to a file; raises InvalidInput as `backup` does."""
    source = _existing(url, to)
    with _opened(source, "mode=ro") as store:
        _check_revision(store, source)
        (newest,) = store.execute("SELECT coalesce(max(id), 0) FROM messages").fetchone()
        return int(newest)


def restore(backed_up: Path, url: str, progress: Progress | None = None) -> CopiedStore:
    """Restore a backup to a store that does not exist or is empty.

    Messages posted since the backup are lost here but known to the edges, which ignore serials up to the last one that
    they received. So the serials continue far above those in the backup.
    Every edge is asked for the windows that it still keeps: those since the backup are not in it. Servos that the
    backup leaves out begin anew, with an alarm.

    Raises
    ------
    InvalidInput
        The backup is damaged or of a newer servotwin; the store holds data, is in use, or is in PostgreSQL.
    """
    place = _source_file(url, "pg_restore --dbname=DATABASE {}", backed_up)
    check_named(place, "store ")
    check_named(backed_up, "backup ")
    if not backed_up.is_file():
        raise InvalidInput(f"backup {backed_up}: there is no such file")
    _check_free(place)
    with atomic_output(place, PRIVATE) as temporary:
        copied = _copied(backed_up, temporary, place, progress)
        _bring_up_to_date(temporary, place)
        with _opened(temporary, "mode=rw", place) as store:
            store.execute("PRAGMA journal_mode = DELETE")
            store.executemany("INSERT INTO twins (servo) VALUES (?)", [(servo,) for servo in copied.left_out])
            # Serials that edges received after the backup must not be used again.
            # Not by a margin alone: a second restore of one backup would use those of the first.
            serials = (_SERIAL_MARGIN + 1, fresh_serial(time.time()))
            store.execute("UPDATE twins SET posted = max(posted + ?, ?)", serials)
            _ask_for_windows(store, copied.left_out)
            if copied.left_out:
                store.execute(f"DELETE FROM {set_aside.name}")
        return copied


def _bring_up_to_date(file: Path, place: Path) -> None:
    """Upgrade a copy of a store of an earlier revision: what follows is written into the tables of today."""
    engines = engines_of(sa.URL.create(SQLITE, database=str(file)))
    try:
        migrate(engines.writer)
    except StoreUnavailable as error:
        raise _not_written(place, error) from None
    finally:
        engines.dispose()


def _ask_for_windows(store: sqlite3.Connection, left_out: Mapping[str, str]) -> None:
    """Ask every edge for the windows that it still keeps, and note the hole in the evidence of its servo."""
    reason, now = "the twin's store was restored from a backup", time.time()
    known = store.execute("SELECT servo, posted FROM twins").fetchall()
    rows = [(servo, serial, encode(Resend(servo, reason=reason)), now) for servo, serial in known]
    store.executemany("INSERT INTO outgoing (servo, serial, body, created) VALUES (?, ?, ?, ?)", rows)
    last = store.execute("SELECT received FROM messages ORDER BY id DESC LIMIT 1").fetchone()
    backed_up = (
        ""
        if last is None
        else datetime.fromtimestamp(last[0], UTC).strftime(" whose newest message came on %Y-%m-%d %H:%M:%S UTC")
    )
    lacks = {servo: f", which lacks all of this servo ({why})" for servo, why in left_out.items()}
    alarms = [alarm_row(servo, f"{reason}{backed_up}{lacks.get(servo, '')}. {LOST_ANSWERS}", now) for servo, _ in known]
    store.executemany(_ADD_ALARM, alarms)


def _existing(url: str, to: Path) -> Path:
    """File of the store that is to be copied."""
    source = _source_file(url, "pg_dump --format=custom --file={} DATABASE", to)
    check_named(source, "store ")
    if not source.is_file():
        raise InvalidInput(f"store {source}: there is no such file; give that of a store")
    return source


def _source_file(url: str, command: str, file: Path) -> Path:
    address = parse_address(url)
    path = sqlite_file(address)
    if path is not None:
        return path
    if address.get_backend_name() == POSTGRESQL:
        raise InvalidInput(f"store {public_address(address)}: is in PostgreSQL; call {command.format(file)}")
    raise InvalidInput(f"store {public_address(address)}: is in memory; give that of a file")


def _copied(source: Path, target: Path, to: Path, progress: Progress | None) -> CopiedStore:
    """Copy the source as of one moment into the target, which will be named `to`; compare and check it.

    Without the rows of servos that are set aside: a twin would not read them.
    """
    with _opened(target, "mode=rw", to) as copy:
        with _opened(source, "mode=ro") as original:
            # The first read fixes the snapshot: later writes go to the log.
            original.execute("BEGIN")
            _check_revision(original, source)
            expected = _counts(original)
            _copy_pages(original, copy, to, progress)
            original.execute("ROLLBACK")
        # Without a write-ahead log the copy is a single file.
        copy.execute("PRAGMA journal_mode = DELETE")
        if fault := _fault_of_pages(copy):
            raise InvalidInput(f"store {source}: is damaged ({fault}); restore an earlier backup")
        # Compared as well as checked: a copy may be sound and yet lack rows.
        if _counts(copy) != expected:
            raise InvalidInput(f"store {source}: its copy does not hold the same rows; try again")
        left_out = _leave_out(copy)
        if fault := _fault_of_values(copy):
            raise InvalidInput(f"store {source}: is damaged ({fault}); restore an earlier backup")
        return CopiedStore(_counts(copy) if left_out else expected, left_out)


def _leave_out(copy: sqlite3.Connection) -> dict[str, str]:
    """Delete all rows of servos that are set aside, but for the note of it; returns them, each with a clause."""
    if set_aside.name not in _tables(copy):  # an earlier revision
        return {}
    left_out = {str(servo): str(why) for servo, why in copy.execute(f"SELECT servo, clause FROM {set_aside.name}")}
    of_servo = [(servo,) for servo in left_out]
    copy.executemany("DELETE FROM bodies WHERE message IN (SELECT id FROM messages WHERE servo = ?)", of_servo)
    for table in reversed(metadata.sorted_tables):
        if "servo" in table.columns and table is not set_aside:
            copy.executemany(f"DELETE FROM {table.name} WHERE servo = ?", of_servo)
    return dict(sorted(left_out.items()))


def _fault_of_pages(copy: sqlite3.Connection) -> str:
    """First fault of a copy's pages; empty: none."""
    (result,) = copy.execute("PRAGMA integrity_check(1)").fetchone()
    return "" if result == "ok" else str(result).splitlines()[-1]  # the lines before tell the database, which is `main`


def _fault_of_values(copy: sqlite3.Connection) -> str:
    """First wrong value or body of a copy, with which a twin would not write to it; empty: none."""
    for table in metadata.sorted_tables:
        if fault := wrong_value(copy, table):
            return fault
    faults = (body_fault(*row) for row in copy.execute(str(STORED_BODIES)))
    try:
        return next(filter(None, faults), "")
    except sqlite3.OperationalError as error:
        if is_damage(error):
            return damage_words(error)
        raise


def _copy_pages(original: sqlite3.Connection, copy: sqlite3.Connection, to: Path, progress: Progress | None) -> None:
    """Copy all pages; SQLite does not tell which of the two files an error is of."""
    report = None if progress is None else lambda _, left, total: progress(left, total)
    try:
        original.backup(copy, pages=PAGES, progress=report)
    except sqlite3.Error as error:
        if is_damage(error) or error.sqlite_errorcode in _OF_READING:
            raise
        raise _not_written(to, error) from None


@contextmanager
def _opened(path: Path, mode: str, to: Path | None = None) -> Iterator[sqlite3.Connection]:
    """Open a connection; an error of SQLite becomes InvalidInput, of a file that will be named `to` with that name."""
    try:
        uri = f"{path.absolute().as_uri()}?{mode}"
        with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
            yield connection
    except sqlite3.Error as error:
        if to is not None:
            raise _not_written(to, error) from None
        fault = "is damaged" if is_damage(error) else "cannot be read or written"
        raise InvalidInput(f"store {path}: {fault} ({damage_words(error)})") from None


def _not_written(to: Path, error: Exception) -> InvalidInput:
    return InvalidInput(f"output {to}: cannot be written ({error})")


def _check_revision(connection: sqlite3.Connection, path: Path) -> None:
    # Not all tables of today: a backup of an earlier revision lacks the later ones, which the upgrade makes.
    if not _tables(connection) >= {VERSIONS, *RowCounts._fields}:
        raise InvalidInput(f"store {path}: is not a store of servotwin")
    named = connection.execute(f"SELECT version_num FROM {VERSIONS}").fetchone()
    try:
        revision = checked_revision(named and named[0])
    except WrongValue as error:
        raise InvalidInput(f"store {path}: is damaged ({error})") from None
    if revision > REVISION:
        raise InvalidInput(f"store {path}: its schema {revision} is newer than {REVISION}, the newest known here")


def _check_free(place: Path) -> None:
    """Refuse to overwrite a store that holds data or is in use."""
    if not place.exists():
        log = place.with_name(f"{place.name}-wal")
        if log.exists():
            raise InvalidInput(f"store {place}: is missing, but its log {log.name} exists; move that away first")
        return
    with _opened(place, "mode=rw") as connection:
        if any(_rows(connection, table) for table in _tables(connection) - {VERSIONS}):
            raise InvalidInput(f"store {place}: is not empty; restore into a new one")
        connection.execute("PRAGMA busy_timeout = 0")
        try:
            # SQLite gives up the log only to the sole user of a database.
            connection.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.OperationalError:
            raise InvalidInput(f"store {place}: is in use; end its twin first") from None


def _tables(connection: sqlite3.Connection) -> set[str]:
    names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
    return {name for (name,) in names}


def _counts(connection: sqlite3.Connection) -> RowCounts:
    return RowCounts(*(_rows(connection, table) for table in RowCounts._fields))


def _rows(connection: sqlite3.Connection, table: str) -> int:
    query = sa.select(sa.func.count()).select_from(sa.table(table))
    (rows,) = connection.execute(str(query)).fetchone()
    return int(rows)
