"""SQLite file of an edge's outbox: schema, statements, opening and check, and renaming of a corrupt file."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

from servotwin.errors import InvalidInput
from servotwin.messages import InvalidMessage, WindowMessage, decode
from servotwin.messages.codec import DEFLATE, MAX_BYTES, decompress

# FULL: a commit is on the disk before its frame is confirmed, so that a power failure loses nothing confirmed.
# AUTOINCREMENT: places rise for ever, also after deletions, so they give the order of age.
_SCHEMA = """
PRAGMA journal_mode = WAL;
PRAGMA synchronous = FULL;
PRAGMA busy_timeout = 2000;
PRAGMA journal_size_limit = 4194304;
CREATE TABLE IF NOT EXISTS windows (
    place INTEGER PRIMARY KEY AUTOINCREMENT, boot TEXT NOT NULL, sequence INTEGER NOT NULL, reason TEXT NOT NULL,
    encoding TEXT NOT NULL, body BLOB NOT NULL, UNIQUE (boot, sequence));
CREATE TABLE IF NOT EXISTS letters (
    place INTEGER PRIMARY KEY AUTOINCREMENT, digest BLOB NOT NULL UNIQUE, body BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS notes (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS counts (what TEXT PRIMARY KEY, number INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS acknowledged (
    boot TEXT NOT NULL, sequence INTEGER NOT NULL, at REAL NOT NULL, PRIMARY KEY (boot, sequence)) WITHOUT ROWID;
"""
INSERT = "INSERT OR IGNORE INTO windows (boot, sequence, reason, encoding, body) VALUES (?, ?, ?, ?, ?)"
INSERT_AT = "INSERT OR IGNORE INTO windows (place, boot, sequence, reason, encoding, body) VALUES (?, ?, ?, ?, ?, ?)"
DELETE = "DELETE FROM windows WHERE boot = ? AND sequence = ?"
ACKNOWLEDGE = "INSERT OR REPLACE INTO acknowledged (boot, sequence, at) VALUES (?, ?, ?)"
AGAIN = -1.0
"""In place of the time of the acknowledgement: the window is sent once more, because the twin has asked for it."""
ASKED_FOR = "DELETE FROM acknowledged WHERE boot = ? AND sequence = ?"
POST = "INSERT OR IGNORE INTO letters (digest, body) VALUES (?, ?)"
TAKE = "DELETE FROM letters WHERE digest = ?"
COUNT = "INSERT INTO counts (what, number) VALUES (?, ?) ON CONFLICT (what) DO UPDATE SET number = excluded.number"
NOTE = "INSERT INTO notes (name, value) VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET value = excluded.value"
SERVO = "servo"
"""Name of the value that says whose outbox the file is; older files lack it."""
_WAITING = (
    f"SELECT count(*) FROM windows LEFT JOIN acknowledged USING (boot, sequence) WHERE ifnull(at, {AGAIN}) = {AGAIN}"
)
STORED = "SELECT seq FROM sqlite_sequence WHERE name = 'windows'"
_STORES_TABLE = "servotwin_version"
_PUT_BACK = "move it to its place, or give another name"
BESIDE = ("-wal", "-shm")


class Statement(NamedTuple):
    """SQL statement and its values."""

    text: str
    values: tuple[Any, ...]


class OtherOutbox(NamedTuple):
    """A file of another servo, which was put aside with all that it holds.

    Attributes
    ----------
    file : path
        Its new name.
    servo : str
    waiting : int
        Windows that wait in it.
    """

    file: Path
    servo: str
    waiting: int


def was_read_only(error: Exception) -> bool:
    """True where the disk was read-only when the file was opened: SQLite's connection stays read-only after that."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_READONLY


def check_kind(path: Path) -> None:
    """Refuse a database of another kind in the place of an outbox; it stays as it is, and so do the files beside it.

    Raises
    ------
    InvalidInput
        It is a twin's store, or has none but tables of another program.
    """
    try:
        # Immutable: SQLite would make a log beside it. What only the log has is new, and no reason to refuse it.
        address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as connection:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except (sqlite3.Error, UnicodeError):
        return  # there is none, or whoever opens it finds it broken
    if _STORES_TABLE in tables:
        raise InvalidInput(f"{path}: is a twin's store, no outbox of an edge; {_PUT_BACK}")
    if tables and "windows" not in tables:
        raise InvalidInput(f"{path}: is another program's database, no outbox of an edge; {_PUT_BACK}")


def connect(path: Path, check: bool = True) -> sqlite3.Connection:
    """Open an outbox's file, made where there is none; `check` tests its integrity.

    Raises
    ------
    sqlite3.Error
        The file cannot be opened, or is corrupt (`is_damage`).
    """
    make_private(path)
    # The outbox begins its transactions itself, and its lock guards the connection for all threads.
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    try:
        connection.executescript(_SCHEMA)
        result = connection.execute("PRAGMA quick_check(1)").fetchone()[0] if check else "ok"
        if result != "ok":
            error = sqlite3.DatabaseError(result)
            error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
            raise error
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def connect_own(path: Path, servo: str) -> tuple[sqlite3.Connection, OtherOutbox | None]:
    """Open an outbox's file; one of another servo, whose windows a twin would refuse, is put aside before.

    Raises
    ------
    sqlite3.Error
        The file cannot be opened, or is corrupt (`is_damage`).
    OSError
        It is of another servo, and cannot be renamed.
    """
    connection = connect(path)
    try:
        owner, [waiting] = _owner_of(connection), connection.execute(_WAITING).fetchone()
    except sqlite3.Error:
        connection.close()
        raise
    if owner in ("", servo):
        return connection, None
    connection.close()
    other = OtherOutbox(put_aside(path, "another"), owner, waiting)
    return connect(path), other


def _owner_of(connection: sqlite3.Connection) -> str:
    """Servo whose outbox a file is; where it does not say so, that of its newest window; empty: it tells none."""
    for (value,) in connection.execute("SELECT value FROM notes WHERE name = ?", (SERVO,)):
        return bytes(value).decode("utf-8", errors="replace")
    for encoding, body in connection.execute("SELECT encoding, body FROM windows ORDER BY place DESC LIMIT 1"):
        with suppress(InvalidMessage):
            message = decode(decompress(body, encoding, MAX_BYTES) if encoding == DEFLATE else body)
            return message.servo if isinstance(message, WindowMessage) else ""
    return ""


def make_private(path: Path) -> None:
    """Make the file where there is none, and let its owner alone open it; SQLite gives its log the same mode."""
    with suppress(OSError):
        # With its mode from the start: between creation and a chmod others could open it.
        os.close(os.open(path, os.O_CREAT | os.O_RDONLY, 0o600))
        if path.stat().st_mode & 0o077:
            path.chmod(0o600)


def put_aside(path: Path, why: str) -> Path:
    """Rename a file that is "broken", or of "another" servo, so that nothing of it is lost; return its new path."""
    number = 1
    while (aside := path.with_name(f"{path.name}.{why}-{number}")).exists():
        number += 1
    path.rename(aside)
    # With its write-ahead log: SQLite would apply that to the new file of the same name.
    for end in BESIDE:
        beside = path.with_name(path.name + end)
        if beside.exists():
            beside.rename(aside.with_name(aside.name + end))
    return aside
