"""An outbox on disk: windows and letters that outlive the process, and what else the link has to remember.

The disk may be full, read-only or broken; the outbox goes on. What it knows is in memory first (an index, and the few
rows that the disk still owes), and every change is written in one transaction before it counts as done; a change that
cannot be written is owed and tried again. Every statement may be repeated, so that nothing depends on how far one got.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from threading import RLock
from typing import Any

from servotwin.errors import InvalidInput
from servotwin.link.eviction import Kept, excess, is_plain
from servotwin.link.outbox import FULL, Dropped, Key
from servotwin.link.sqlite_file import (
    COUNT,
    DELETE,
    INSERT,
    NOTE,
    POST,
    TAKE,
    Statement,
    connect,
    is_broken,
    put_aside,
    was_read_only,
)
from servotwin.link.transport import DEFLATE, Parcel, squeezed
from servotwin.messages import Window, decode, encode

BROKEN, UNWRITABLE, LETTERS = "outbox broken", "disk not writable", "letters full"
MOST_OWED = 16_000_000
"""Bytes of windows that are held in memory while the disk cannot be written."""
MOST_LETTERS = 10_000

_DROPPED = "dropped: "


class SqliteOutbox:
    """Unacknowledged windows, letters not taken, and counts; to be used from any thread.

    When it is full the oldest uninformative windows go first, then the oldest.

    Parameters
    ----------
    path : path
        Its folder exists.
    servo : str
    windows, size : int
        Windows, and bytes of windows, kept at most.
    """

    def __init__(self, path: Path, servo: str, windows: int = 5000, size: int = 256_000_000) -> None:
        if windows < 1 or size < 1:
            raise InvalidInput(f"outbox of {windows!r} windows and {size!r} bytes: must be at least 1 of each")
        self._path, self._servo, self._windows, self._size = path, servo, windows, size
        self._lock = RLock()
        self._connection: sqlite3.Connection | None = None
        self._read_only = False
        self._index: dict[Key, Kept] = {}
        self._letters: dict[bytes, None] = {}
        self._counts: Counter[str] = Counter()
        self._notes: dict[str, bytes] = {}
        self._held = False
        self._owed: dict[tuple[Any, ...], Statement] = {}
        self.faults: Counter[str] = Counter()
        self.trouble = ""
        self.settle()

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows given up since the file was made, by reason."""
        counts = dict(self._counts).items()
        return {name.removeprefix(_DROPPED): number for name, number in counts if name.startswith(_DROPPED)}

    @property
    def safe(self) -> bool:
        """Whether everything is on the disk."""
        with self._lock:
            return not self._owed and self._connection is not None

    def put(self, window: Window) -> list[Dropped]:
        """Keep a window, on the disk when this returns unless `safe` is False; what had to go to make room."""
        body, encoding = squeezed(encode(window))
        key = window.boot, window.sequence
        with self._lock:
            if key in self._index:
                return []
            self._index[key] = Kept(len(body), is_plain(window.reason))
            self._owed["window", key] = Statement(INSERT, (*key, window.reason, encoding, body))
            drops = [Dropped(each, FULL) for each in excess(self._index, self._windows, self._size)]
            for drop in drops:
                self._forget(drop.key, drop.reason)
            self.settle()
            return drops

    def get(self, key: Key) -> Window:
        """The window; KeyError when it is not (or no longer) kept."""
        parcel = self.parcel(key)
        window = decode(zlib.decompress(parcel.body) if parcel.encoding == DEFLATE else parcel.body)
        assert isinstance(window, Window)
        return window

    def parcel(self, key: Key) -> Parcel:
        """The window as it is sent; KeyError when it is not (or no longer) kept."""
        with self._lock:
            if key not in self._index:
                raise KeyError(key)
            owed = self._owed.get(("window", key))
            row = self._read("SELECT encoding, body FROM windows WHERE boot = ? AND sequence = ?", key)
            if owed is None and not row:
                raise KeyError(key)
            encoding, body = owed.values[3:] if owed is not None else row[0]
            return Parcel(self._servo, body, encoding, *key)

    def remove(self, key: Key) -> bool:
        """Forget an acknowledged window; False when it was not there."""
        with self._lock:
            known = key in self._index
            if known:
                self._forget(key)
                self.settle()
            return known

    def drop(self, key: Key, reason: str) -> None:
        """Give a window up, for a reason that is counted."""
        with self._lock:
            if key in self._index:
                self._forget(key, reason)
                self.settle()

    def lost(self, reason: str) -> None:
        """Count a window that was given up before it came here."""
        with self._lock:
            self._count(_DROPPED + reason)
            self.settle()

    def pending(self) -> list[Key]:
        """Keys of every window kept, oldest first."""
        with self._lock:
            return list(self._index)

    def post(self, body: bytes) -> None:
        """Keep a letter (an encoded message) until it is taken; the same one twice is one."""
        digest = blake2b(body, digest_size=16).digest()
        with self._lock:
            self._letters[digest] = None
            self._owed["letter", digest] = Statement(POST, (digest, body))
            if len(self._letters) > MOST_LETTERS:
                self._count(_DROPPED + LETTERS)
                self.taken(next(iter(self._letters)))
            self.settle()

    def letters(self) -> list[bytes]:
        """Digests of the letters kept, oldest first."""
        return list(self._letters)

    def letter(self, digest: bytes) -> Parcel:
        """A letter as it is sent; KeyError when it is not kept."""
        with self._lock:
            owed = self._owed.get(("letter", digest)) if digest in self._letters else None
            row = self._read("SELECT body FROM letters WHERE digest = ?", (digest,))
            if digest not in self._letters or (owed is None and not row):
                raise KeyError(digest)
            return Parcel(self._servo, owed.values[1] if owed is not None else row[0][0])

    def taken(self, digest: bytes) -> None:
        """Forget a letter."""
        with self._lock:
            self._letters.pop(digest, None)
            self._owed["letter", digest] = Statement(TAKE, (digest,))
            self.settle()

    def recall(self, what: str) -> int:
        """A number that was remembered; 0 at first."""
        return self._counts[what]

    def remember(self, what: str, number: int) -> None:
        """Keep a number."""
        with self._lock:
            self._counts[what] = number
            self._owed["count", what] = Statement(COUNT, (what, number))
            self.settle()

    def note(self, name: str, value: bytes) -> None:
        """Keep some bytes."""
        with self._lock:
            self._notes[name] = value
            self._owed["note", name] = Statement(NOTE, (name, value))
            self.settle()

    def noted(self, name: str) -> bytes | None:
        """Bytes that were kept under this name."""
        return self._notes.get(name)

    @contextmanager
    def together(self) -> Iterator[None]:
        """Whatever is done inside is written as one, at the end."""
        with self._lock:
            self._held = True
            try:
                yield
            finally:
                self._held = False
                self.settle()

    def settle(self) -> bool:
        """Write what is owed; whether nothing is left. To be called now and then: it is how the outbox recovers."""
        with self._lock:
            try:
                if not self._held:
                    self._write()
            except (sqlite3.Error, OSError) as error:
                self._failed(error)
            return self.safe

    def close(self) -> None:
        """Let go of the file."""
        with self._lock:
            if self._connection is not None:
                self._connection.close()
            self._connection, self._read_only = None, False

    def _write(self) -> None:
        if self._connection is None:
            self._connection = connect(self._path)
            self._load(self._connection)
        if self._read_only:
            self.close()  # first: connections of one process to one file share what they know of it
            self._connection = connect(self._path, check=False)
        if self._owed:
            self._connection.execute("BEGIN IMMEDIATE")
            for statement in self._owed.values():
                self._connection.execute(statement.text, statement.values)
            self._connection.execute("COMMIT")
            self._owed.clear()
        self.trouble = ""

    def _load(self, connection: sqlite3.Connection) -> None:
        """What the file holds, before what is owed to it."""
        windows = connection.execute("SELECT boot, sequence, reason, length(body) FROM windows ORDER BY place")
        found = {(boot, number): Kept(size, is_plain(reason)) for boot, number, reason, size in windows}
        letters = [digest for (digest,) in connection.execute("SELECT digest FROM letters ORDER BY place")]
        counts: dict[str, int] = dict(connection.execute("SELECT what, number FROM counts").fetchall())
        self._index = {**{key: kept for key, kept in found.items() if ("window", key) not in self._owed}, **self._index}
        self._letters = {**{each: None for each in letters if ("letter", each) not in self._owed}, **self._letters}
        self._counts = Counter(counts) | self._counts
        self._notes = dict(connection.execute("SELECT name, value FROM notes").fetchall()) | self._notes

    def _failed(self, error: Exception) -> None:
        """Go on without the disk, or with a new file."""
        self.trouble = str(error)
        if isinstance(error, sqlite3.Error) and is_broken(error):
            self._begin_anew()
            return
        self.faults[UNWRITABLE] += 1
        self._read_only = was_read_only(error) and self._connection is not None
        if self._connection is not None and self._connection.in_transaction:
            self._rolled_back(self._connection)
        held = [(key, owed) for key, owed in self._owed.items() if owed.text == INSERT]
        size = sum(len(owed.values[4]) for _, owed in held)
        while size > MOST_OWED:
            key, owed = held.pop(0)
            size -= len(owed.values[4])
            self._forget(key[1], UNWRITABLE)

    def _rolled_back(self, connection: sqlite3.Connection) -> None:
        try:
            connection.execute("ROLLBACK")
        except sqlite3.Error:
            self.close()

    def _begin_anew(self) -> None:
        """Put the broken file aside; what is not owed to it is lost, and counted."""
        self.close()
        self.faults[BROKEN] += 1
        kept = {key for kind, key in self._owed if kind == "window"}
        for key in [key for key in self._index if key not in kept]:
            del self._index[key]
            self._count(_DROPPED + BROKEN)
        self._letters = {digest: None for digest in self._letters if ("letter", digest) in self._owed}
        self._count(BROKEN)
        self._owed |= {("count", what): Statement(COUNT, (what, n)) for what, n in self._counts.items()}
        self._owed |= {("note", name): Statement(NOTE, (name, value)) for name, value in self._notes.items()}
        try:
            put_aside(self._path)
        except OSError as error:
            self.trouble = str(error)
            return
        self.settle()

    def _read(self, text: str, values: tuple[Any, ...]) -> list[Any]:
        try:
            return [] if self._connection is None else self._connection.execute(text, values).fetchall()
        except sqlite3.Error as error:
            self._failed(error)
            return []

    def _forget(self, key: Key, reason: str | None = None) -> None:
        self._index.pop(key, None)
        self._owed["window", key] = Statement(DELETE, key)
        if reason is not None:
            self._count(_DROPPED + reason)

    def _count(self, what: str) -> None:
        self._counts[what] += 1
        self._owed["count", what] = Statement(COUNT, (what, self._counts[what]))
