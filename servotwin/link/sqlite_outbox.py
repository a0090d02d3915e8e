"""An outbox on disk: windows and letters that outlive the process, and the counts and values of the link.

The outbox goes on while the disk is full, read-only or corrupt. Memory has the index and the few rows that are not on
the disk yet. Each change is written in one transaction before it counts as done, and again where the disk fails. Every
statement may be repeated, so that a transaction whose outcome is not known is simply written again.
"""

from __future__ import annotations

import sqlite3
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

from servotwin.errors import InvalidInput
from servotwin.link.outbox import FULL, Dropped, Key, letter_digest
from servotwin.link.outbox_index import (
    AcknowledgedLimits,
    AcknowledgedWindows,
    Entry,
    LastStatus,
    excess,
    is_uninformative,
)
from servotwin.link.rebuild import Rebuild, adopt
from servotwin.link.salvage import Row, Salvage, Salvaged
from servotwin.link.sqlite_file import (
    ACKNOWLEDGE,
    AGAIN,
    ASKED_FOR,
    COUNT,
    DELETE,
    INSERT,
    NOTE,
    POST,
    STORED,
    TAKE,
    Statement,
    connect,
    is_broken,
    was_read_only,
)
from servotwin.link.transport import Parcel
from servotwin.messages import WindowMessage, decode, encode
from servotwin.messages.codec import DEFLATE, deflated

BROKEN, INCOMPLETE = "outbox broken", "outbox incomplete"
UNWRITABLE, LETTERS = "disk not writable", "letters full"
MOST_UNWRITTEN = 16_000_000
"""Bytes of windows held in memory while the disk cannot be written."""
_MOST_LETTERS = 10_000
_DROPPED = "dropped: "


class SqliteOutbox:
    """Unacknowledged windows and letters, counts and values; for use from any thread.

    A full outbox takes back windows that are sent once more, then drops the oldest uninformative ones, then the oldest.

    Parameters
    ----------
    path : path
        Its folder exists.
    servo : str
    windows, size : int
        Largest number of windows, and of their bytes.
    kept : AcknowledgedLimits, optional
        Limits of the windows that stay after their acknowledgement, for a twin that asks for them again; none by
        default.
    last : LastStatus, optional
        When the last process ended, as far as is known: windows of a corrupt file that cannot be found even by name are
        counted from it, and those that a file lacks which is older than that.
    clock : callable
        Monotonic, s.

    Attributes
    ----------
    salvages : list of Salvage
        Corrupt files of this process.
    missing : int
        Windows that waited at the last status, and are not in the file: it is an older one, or without its log.
    """

    def __init__(
        self,
        path: Path,
        servo: str,
        windows: int = 5000,
        size: int = 256_000_000,
        kept: AcknowledgedLimits | None = None,
        last: LastStatus | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if windows < 1 or size < 1:
            raise InvalidInput(f"outbox of {windows!r} windows and {size!r} bytes: must be at least 1 of each")
        self._path, self._servo, self._windows, self._size = path, servo, windows, size
        self._kept = AcknowledgedWindows(kept or AcknowledgedLimits(0, 0.0), clock)
        self._last: LastStatus | None = last
        self._stored = self.missing = 0
        self.salvages: list[Salvage] = []
        self._lock = RLock()
        self._connection: sqlite3.Connection | None = None
        self._read_only = False
        self._index: dict[Key, Entry] = {}
        self._letters: dict[bytes, None] = {}
        self._counts: Counter[str] = Counter()
        self._notes: dict[str, bytes] = {}
        self._in_transaction = False
        self._unwritten: dict[tuple[Any, ...], Statement] = {}
        self._rebuild: tuple[Rebuild, int] | None = None
        self.faults: Counter[str] = Counter()
        self.trouble = ""
        self.flush()

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of windows dropped since the file was made, by reason."""
        counts = dict(self._counts).items()
        return {name.removeprefix(_DROPPED): number for name, number in counts if name.startswith(_DROPPED)}

    @property
    def stored(self) -> int:
        """Number of windows that the file has stored so far."""
        with self._lock:
            self._stored = max([self._stored, *(number for (number,) in self._read(STORED, ()))])
            return self._stored

    @property
    def flushed(self) -> bool:
        """Everything is on the disk."""
        with self._lock:
            return not self._unwritten and self._connection is not None

    def put(self, window: WindowMessage) -> list[Dropped]:
        """Store a window; return the windows dropped to make room. It is on the disk unless `flushed` is False."""
        body, encoding = deflated(encode(window))
        key = window.boot, window.sequence
        with self._lock:
            if key in self._index or key in self._kept.entries:
                return []
            self._index[key] = Entry(len(body), is_uninformative(window.reason))
            self._unwritten["window", key] = Statement(INSERT, (*key, window.reason, encoding, body))
            drops = self._make_room()
            self.flush()
            return drops

    def get(self, key: Key) -> WindowMessage:
        """Return a window; KeyError when it is not stored (any more)."""
        parcel = self.parcel(key)
        window = decode(zlib.decompress(parcel.body) if parcel.encoding == DEFLATE else parcel.body)
        assert isinstance(window, WindowMessage)
        return window

    def parcel(self, key: Key) -> Parcel:
        """Return a window as it is sent; KeyError when it is not stored (any more)."""
        with self._lock:
            if key not in self._index:
                raise KeyError(key)
            unwritten = self._unwritten.get(("window", key))
            row = self._read("SELECT encoding, body FROM windows WHERE boot = ? AND sequence = ?", key)
            if unwritten is None and not row:
                raise KeyError(key)
            encoding, body = unwritten.values[3:] if unwritten is not None else row[0]
            return Parcel(self._servo, body, encoding, *key)

    def remove(self, key: Key) -> bool:
        """Remove an acknowledged window; False when it was not there."""
        with self._lock:
            entry = self._index.get(key)
            if entry is not None:
                self._keep(key, entry)
                self.flush()
            return entry is not None

    def resend(self, wanted: Callable[[str, int], bool]) -> int:
        """Put back acknowledged windows for which `wanted(boot, sequence)` is true, the newest that there is room for.

        Returns their number. They are sent after all others, and the first ones to give way.
        """
        with self._lock:
            found = [key for key in self._kept.entries if wanted(*key)]
            for key in found:
                self._index[key] = Entry(self._kept.take(key), uninformative=False, again=True)
                self._unwritten["acknowledged", key] = Statement(ACKNOWLEDGE, (*key, AGAIN))
            self._make_room()
            self.flush()
            return sum(key in self._index for key in found)

    def drop(self, key: Key, reason: str) -> None:
        """Drop a window and count it under a reason."""
        with self._lock:
            if key in self._index:
                self._forget(key, reason)
                self.flush()

    def count_dropped(self, reason: str) -> None:
        """Count a window that was dropped before it was put here."""
        with self._lock:
            self._count(_DROPPED + reason)
            self.flush()

    def pending(self) -> list[Key]:
        """Keys of all windows, oldest first; those that are sent once more come last."""
        with self._lock:
            return sorted(self._index, key=lambda key: self._index[key].again)

    def newest(self) -> Key | None:
        """Key of the newest window that the twin has never acknowledged; None: there is none."""
        with self._lock:
            return next((key for key, entry in reversed(self._index.items()) if not entry.again), None)

    def put_letter(self, body: bytes) -> None:
        """Store a letter (an encoded message); equal letters are stored once."""
        digest = letter_digest(body)
        with self._lock:
            self._letters[digest] = None
            self._unwritten["letter", digest] = Statement(POST, (digest, body))
            if len(self._letters) > _MOST_LETTERS:
                self._count(_DROPPED + LETTERS)
                self.remove_letter(next(iter(self._letters)))
            self.flush()

    def letters(self) -> list[bytes]:
        """Digests of all letters, oldest first."""
        return list(self._letters)

    def letter(self, digest: bytes) -> Parcel:
        """Return a letter as it is sent; KeyError when it is not stored."""
        with self._lock:
            unwritten = self._unwritten.get(("letter", digest)) if digest in self._letters else None
            row = self._read("SELECT body FROM letters WHERE digest = ?", (digest,))
            if digest not in self._letters or (unwritten is None and not row):
                raise KeyError(digest)
            return Parcel(self._servo, unwritten.values[1] if unwritten is not None else row[0][0])

    def remove_letter(self, digest: bytes) -> bool:
        """Remove a letter; False when it was not there."""
        with self._lock:
            known = digest in self._letters
            self._letters.pop(digest, None)
            self._unwritten["letter", digest] = Statement(TAKE, (digest,))
            self.flush()
            return known

    def number(self, name: str) -> int:
        """Return the number stored under a name; 0 at first."""
        return self._counts[name]

    def set_number(self, name: str, number: int) -> None:
        """Store a number under a name."""
        with self._lock:
            self._counts[name] = number
            self._unwritten["count", name] = Statement(COUNT, (name, number))
            self.flush()

    def set_value(self, name: str, value: bytes) -> None:
        """Store bytes under a name."""
        with self._lock:
            self._notes[name] = value
            self._unwritten["note", name] = Statement(NOTE, (name, value))
            self.flush()

    def value(self, name: str) -> bytes | None:
        """Return the bytes stored under a name; None: there are none."""
        return self._notes.get(name)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Write all changes of a `with` block in one transaction, at its end."""
        with self._lock:
            self._in_transaction = True
            try:
                yield
            finally:
                self._in_transaction = False
                self.flush()

    def flush(self) -> bool:
        """Write the changes that are not on the disk; False where some are left.

        Call it periodically: the outbox recovers from a failure of the disk only here and at the next change.
        """
        with self._lock:
            try:
                if not self._in_transaction:
                    self._write()
            except (sqlite3.Error, OSError) as error:
                self._failed(error)
            return self.flushed

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            if self._connection is not None:
                self._connection.close()
            self._connection, self._read_only = None, False

    def _write(self) -> None:
        if self._connection is None:
            adopt(self._path)  # of a process that was killed between two renames
            self._connection = connect(self._path)
            self._load(self._connection)
        if self._read_only:
            self.close()  # before connecting again: connections of one process to one file share its state
            self._connection = connect(self._path, check=False)
        if self._unwritten:
            # IMMEDIATE takes the write lock now: a file that is locked fails here, before the first statement.
            self._connection.execute("BEGIN IMMEDIATE")
            for statement in self._unwritten.values():
                self._connection.execute(statement.text, statement.values)
            self._connection.execute("COMMIT")
            self._unwritten.clear()
        self.trouble = ""

    def _load(self, connection: sqlite3.Connection) -> None:
        """Load the file's index; changes in memory, which are newer, take precedence."""
        windows = connection.execute("SELECT boot, sequence, reason, length(body) FROM windows ORDER BY place")
        stored = {(boot, number): Entry(size, is_uninformative(reason)) for boot, number, reason, size in windows}
        letters = [digest for (digest,) in connection.execute("SELECT digest FROM letters ORDER BY place")]
        counts: dict[str, int] = dict(connection.execute("SELECT what, number FROM counts").fetchall())
        acknowledged = connection.execute("SELECT boot, sequence, at FROM acknowledged").fetchall()
        times = {(boot, number): at for boot, number, at in acknowledged if (boot, number) in stored}
        stored |= {key: stored[key]._replace(again=True) for key, at in times.items() if at == AGAIN}
        self._kept.load((key, stored.pop(key).size, at) for key, at in times.items() if at != AGAIN)
        # Windows of the file first: they are older, and the index is in the order of age.
        self._index = {
            **{key: entry for key, entry in stored.items() if ("window", key) not in self._unwritten},
            **self._index,
        }
        self._letters = {**{each: None for each in letters if ("letter", each) not in self._unwritten}, **self._letters}
        self._counts = Counter(counts) | self._counts
        self._notes = dict(connection.execute("SELECT name, value FROM notes").fetchall()) | self._notes
        if self._last is not None:
            lacks = self._last.stored - sum(number for (number,) in connection.execute(STORED))
            self.missing = max(0, min(lacks, self._last.waiting))
            self._count(_DROPPED + INCOMPLETE, self.missing)
            self._last = None

    def _failed(self, error: Exception) -> None:
        """Go on without the disk, or with a new file."""
        self.trouble = str(error)
        if isinstance(error, sqlite3.Error) and is_broken(error):
            self._begin_anew()
            return
        self.faults[UNWRITABLE] += 1
        self._read_only = was_read_only(error) and self._connection is not None
        if self._connection is not None and self._connection.in_transaction:
            self._roll_back(self._connection)
        windows = [(key, statement) for key, statement in self._unwritten.items() if statement.text == INSERT]
        size = sum(len(statement.values[4]) for _, statement in windows)
        while size > MOST_UNWRITTEN:  # drop the oldest: a disk that stays full must not fill the memory
            key, statement = windows.pop(0)
            size -= len(statement.values[4])
            self._forget(key[1], UNWRITABLE)

    def _roll_back(self, connection: sqlite3.Connection) -> None:
        try:
            connection.execute("ROLLBACK")
        except sqlite3.Error:
            self.close()

    def _begin_anew(self) -> None:
        """Put the corrupt file aside and begin another, with all that can be read of it; count the rest as lost."""
        self.close()
        if self._rebuild is None:
            self.faults[BROKEN] += 1
            self._salvage()
        assert self._rebuild is not None
        rebuild, lost = self._rebuild
        try:
            aside = rebuild.rename()
        except OSError as error:  # a read-only disk: the next try renames it only
            self.trouble = str(error)
            return
        self._rebuild = None
        self.salvages.append(Salvage(aside, len(rebuild.found.windows), lost))
        self.flush()

    def _salvage(self) -> None:
        """Read the corrupt file, and take over its letters, counts and values; what is in memory is newer."""
        in_memory = {key for kind, key in self._unwritten if kind == "window"}
        rebuild = Rebuild(self._path, in_memory, MOST_UNWRITTEN)
        found, known = rebuild.found, rebuild.found.windows | rebuild.dropped | in_memory
        # Known by name: from memory where the file was open before, and from what is left of the file.
        lost = (self._index.keys() | found.lost) - known
        # The number of the last status is old by up to a second: it counts only where the names are not known.
        unnamed = not (self._index or found.lost_is_complete)
        waiting = 0 if self._last is None else self._last.waiting
        number = max(len(lost), waiting - len(known - in_memory) if unnamed else 0)
        self._restore(found, rebuild.in_memory, in_memory)
        self._count(_DROPPED + BROKEN, number)
        self._count(_DROPPED + UNWRITABLE, len(rebuild.dropped))
        self._count(BROKEN)
        self._unwritten |= {("count", what): Statement(COUNT, (what, n)) for what, n in self._counts.items()}
        self._unwritten |= {("note", name): Statement(NOTE, (name, value)) for name, value in self._notes.items()}
        self._last = None
        rebuild.complete(self._unwritten.values())
        self._rebuild = rebuild, number

    def _restore(self, found: Salvaged, rows: Sequence[Row], in_memory: set[Key]) -> None:
        """Take over letters, counts and values of a corrupt file, and windows that are in no new one."""
        unwritten: dict[tuple[Any, ...], Statement] = {
            ("window", (row[1], row[2])): Statement(INSERT, row[1:]) for row in rows
        }
        letters = {digest: body for digest, body in found.letters if ("letter", digest) not in self._unwritten}
        unwritten |= {("letter", digest): Statement(POST, (digest, body)) for digest, body in letters.items()}
        self._index = {
            **{(row[1], row[2]): Entry(len(row[5]), is_uninformative(row[3])) for row in rows},
            **{key: entry for key, entry in self._index.items() if key in in_memory},
        }
        known = {digest for digest in self._letters if ("letter", digest) in self._unwritten}
        self._letters = dict.fromkeys([*letters, *(digest for digest in self._letters if digest in known)])
        self._unwritten = unwritten | self._unwritten
        self._counts = Counter(found.counts) | self._counts
        self._notes = found.notes | self._notes
        self._kept.load(())

    def _read(self, text: str, values: tuple[Any, ...]) -> list[Any]:
        try:
            return [] if self._connection is None else self._connection.execute(text, values).fetchall()
        except sqlite3.Error as error:
            self._failed(error)
            return []

    def _make_room(self) -> list[Dropped]:
        """Drop windows until the limits are met; return them. One that was acknowledged is kept as it was before."""
        drops = list[Dropped]()
        for key in excess(self._index, self._windows, self._size):
            if self._index[key].again:
                self._keep(key, self._index[key])
            else:
                self._forget(key, FULL)
                drops.append(Dropped(key, FULL))
        return drops

    def _forget(self, key: Key, reason: str | None = None) -> None:
        entry = self._index.pop(key, None)
        if entry is not None and entry.again:
            self._unwritten["acknowledged", key] = Statement(ASKED_FOR, key)
        self._unwritten["window", key] = Statement(DELETE, key)
        if reason is not None:
            self._count(_DROPPED + reason)

    def _keep(self, key: Key, entry: Entry) -> None:
        """Keep an acknowledged window for a while; one that is not on the disk yet is forgotten."""
        if ("window", key) in self._unwritten or not self._kept.limits.bytes:
            self._forget(key)
            return
        del self._index[key]
        now = self._kept.now()
        self._unwritten["acknowledged", key] = Statement(ACKNOWLEDGE, (*key, now))
        for old in self._kept.add(key, entry.size, now):
            self._unwritten["window", old] = Statement(DELETE, old)
            self._unwritten["acknowledged", old] = Statement(ASKED_FOR, old)

    def _count(self, what: str, number: int = 1) -> None:
        if number < 1:
            return
        self._counts[what] += number
        self._unwritten["count", what] = Statement(COUNT, (what, self._counts[what]))
