"""An outbox on disk: windows and letters that outlive the process, and the counts and values of the link.

The outbox goes on while the disk is full, read-only or corrupt. Memory has the index and the few rows that are not on
the disk yet (`OutboxContents`). Each change is written in one transaction before it counts as done, and again where the
disk fails.
"""

from __future__ import annotations

import sqlite3
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

from servotwin.errors import InvalidInput
from servotwin.link.moved_file import MovedFiles, write_anew
from servotwin.link.outbox import Dropped, Key
from servotwin.link.outbox_contents import BROKEN, DROPPED, UNWRITABLE, OutboxContents
from servotwin.link.outbox_index import AcknowledgedLimits, AcknowledgedWindows, LastStatus
from servotwin.link.rebuild import Rebuild, adopt, rebuilt
from servotwin.link.salvage import Salvage
from servotwin.link.sqlite_file import (
    BESIDE,
    SERVO,
    STORED,
    OtherOutbox,
    check_kind,
    connect,
    connect_own,
    was_read_only,
)
from servotwin.link.transport import Parcel
from servotwin.messages import WindowMessage, decode, encode
from servotwin.messages.codec import DEFLATE, deflated
from servotwin.runtime.files import FilesInPlace
from servotwin.runtime.sqlite_damage import is_damage

INCOMPLETE, ANOTHER, MOVED = "outbox incomplete", "outbox of another servo", "outbox moved"
LETTERS = "letters full"
MOST_UNWRITTEN = 16_000_000
"""Bytes of windows held in memory while the disk cannot be written."""
_MOST_LETTERS = 10_000


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

    Raises
    ------
    InvalidInput
        A limit is not allowed, or the file is of another kind.

    Attributes
    ----------
    salvages : list of Salvage
        Corrupt files of this process.
    others : list of OtherOutbox
        Files of other servos that were in this one's place.
    moves : list of MovedFiles
        Files of this outbox that were deleted, moved or replaced, and are written anew.
    missing : int
        Windows that waited at the last status, and are not in the file: it is an older one, or without its log.
    empty : bool
        The file was missing, or held nothing at all.
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
        check_kind(path)
        self._path, self._servo, self._windows, self._size = path, servo, windows, size
        self._contents = OutboxContents(AcknowledgedWindows(kept or AcknowledgedLimits(0, 0.0), clock))
        self._last: LastStatus | None = last
        self._stored, self.missing, self.empty = 0, 0, False
        self.salvages: list[Salvage] = []
        self.others: list[OtherOutbox] = []
        self.moves: list[MovedFiles] = []
        self._lock = RLock()
        self._connection: sqlite3.Connection | None = None
        self._files = FilesInPlace(())
        self._read_only, self._displaced = False, False
        self._in_transaction = False
        self._rebuild: tuple[Rebuild, int] | None = None
        self.faults: Counter[str] = Counter()
        self.trouble = ""
        self.flush()

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of windows dropped since the file was made, by reason."""
        counts = dict(self._contents.counts).items()
        return {name.removeprefix(DROPPED): number for name, number in counts if name.startswith(DROPPED)}

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
            return not (self._contents.unwritten or self._displaced or self._connection is None)

    def put(self, window: WindowMessage) -> list[Dropped]:
        """Store a window; return the windows dropped to make room. It is on the disk unless `flushed` is False."""
        body, encoding = deflated(encode(window))
        key = window.boot, window.sequence
        with self._lock:
            if self._contents.has_window(key):
                return []
            self._contents.add_window(key, window.reason, encoding, body)
            drops = self._contents.make_room(self._windows, self._size)
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
            if key not in self._contents.index:
                raise KeyError(key)
            unwritten = self._contents.unwritten.get(("window", key))
            row = self._read("SELECT encoding, body FROM windows WHERE boot = ? AND sequence = ?", key)
            if unwritten is None and not row:
                raise KeyError(key)
            encoding, body = unwritten.values[3:] if unwritten is not None else row[0]
            return Parcel(self._servo, body, encoding, *key)

    def remove(self, key: Key) -> bool:
        """Remove an acknowledged window; False when it was not there."""
        with self._lock:
            known = key in self._contents.index
            if known:
                self._contents.acknowledge(key)
                self.flush()
            return known

    def resend(self, wanted: Callable[[str, int], bool]) -> int:
        """Put back acknowledged windows for which `wanted(boot, sequence)` is true, the newest that there is room for.

        Returns their number. They are sent after all others, and the first ones to give way.
        """
        with self._lock:
            found = self._contents.put_back(wanted)
            self._contents.make_room(self._windows, self._size)
            self.flush()
            return sum(key in self._contents.index for key in found)

    def drop(self, key: Key, reason: str) -> None:
        """Drop a window and count it under a reason."""
        with self._lock:
            if key in self._contents.index:
                self._contents.forget(key, reason)
                self.flush()

    def count_dropped(self, reason: str) -> None:
        """Count a window that was dropped before it was put here."""
        with self._lock:
            self._contents.count_dropped(reason)
            self.flush()

    def pending(self) -> list[Key]:
        """Keys of all windows, oldest first; those that are sent once more come last."""
        with self._lock:
            return self._contents.pending()

    @property
    def waiting(self) -> int:
        """Number of windows."""
        return len(self._contents.index)

    def oldest(self) -> Key | None:
        """Key of the first window of `pending`; None: there is none."""
        with self._lock:
            return self._contents.oldest()

    def newest(self) -> Key | None:
        """Key of the newest window that the twin has never acknowledged; None: there is none."""
        with self._lock:
            return self._contents.newest()

    def put_letter(self, body: bytes) -> None:
        """Store a letter (an encoded message); equal letters are stored once."""
        with self._lock:
            self._contents.add_letter(body)
            if len(self._contents.letters) > _MOST_LETTERS:
                self._contents.count_dropped(LETTERS)
                self._contents.take_letter(next(iter(self._contents.letters)))
            self.flush()

    def letters(self) -> list[bytes]:
        """Digests of all letters, oldest first."""
        return list(self._contents.letters)

    def letter(self, digest: bytes) -> Parcel:
        """Return a letter as it is sent; KeyError when it is not stored."""
        with self._lock:
            letters = self._contents.letters
            unwritten = self._contents.unwritten.get(("letter", digest)) if digest in letters else None
            row = self._read("SELECT body FROM letters WHERE digest = ?", (digest,))
            # Again: a read that finds the file corrupt begins another one.
            if digest not in self._contents.letters or (unwritten is None and not row):
                raise KeyError(digest)
            return Parcel(self._servo, unwritten.values[1] if unwritten is not None else row[0][0])

    def remove_letter(self, digest: bytes) -> bool:
        """Remove a letter; False when it was not there."""
        with self._lock:
            known = self._contents.take_letter(digest)
            self.flush()
            return known

    def number(self, name: str) -> int:
        """Return the number stored under a name; 0 at first."""
        return self._contents.counts[name]

    def set_number(self, name: str, number: int) -> None:
        """Store a number under a name."""
        with self._lock:
            self._contents.set_number(name, number)
            self.flush()

    def set_value(self, name: str, value: bytes) -> None:
        """Store bytes under a name."""
        with self._lock:
            self._contents.set_value(name, value)
            self.flush()

    def value(self, name: str) -> bytes | None:
        """Return the bytes stored under a name; None: there are none."""
        return self._contents.notes.get(name)

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
            connection, other = connect_own(self._path, self._servo)
            self._use(connection)
            if other is not None:
                self.faults[ANOTHER] += 1
                self.others.append(other)
            self._load(connection)
        if self._read_only:
            self.close()  # before connecting again: connections of one process to one file share its state
            self._use(connect(self._path, check=False))
        assert self._connection is not None
        self._keep_place(self._connection)
        if self._contents.unwritten:
            # IMMEDIATE takes the write lock now: a file that is locked fails here, before the first statement.
            self._connection.execute("BEGIN IMMEDIATE")
            for statement in self._contents.unwritten.values():
                self._connection.execute(statement.text, statement.values)
            self._connection.execute("COMMIT")
            self._contents.unwritten.clear()
        self.trouble = ""

    def _use(self, connection: sqlite3.Connection) -> None:
        self._connection, self._displaced = connection, False
        self._files = FilesInPlace(self._path.with_name(self._path.name + end) for end in ("", *BESIDE[:1]))

    def _keep_place(self, connection: sqlite3.Connection) -> None:
        """Go on in a new file where the present one, or its log, was deleted, moved or replaced."""
        changed = self._files.changed()
        if changed:
            self._displaced = True
            self.moves.append(write_anew(connection, self._path, changed))
            self.faults[MOVED] += 1
            self._use(connect(self._path, check=False))

    def _load(self, connection: sqlite3.Connection) -> None:
        """Load the file's contents, and count the windows that it lacks."""
        self._contents.load(connection)
        if SERVO not in self._contents.notes:
            self.empty = not (self.salvages or self.others or self._contents.counts or self._contents.index)
            self._contents.set_value(SERVO, self._servo.encode())
        if self._last is not None:
            lacks = self._last.stored - sum(number for (number,) in connection.execute(STORED))
            self.missing = max(0, min(lacks, self._last.waiting))
            self._contents.count_dropped(INCOMPLETE, self.missing)
            self._last = None

    def _failed(self, error: Exception) -> None:
        """Go on without the disk, or with a new file."""
        self.trouble = str(error)
        if isinstance(error, sqlite3.Error) and is_damage(error):
            self._begin_anew()
            return
        self.faults[UNWRITABLE] += 1
        self._read_only = was_read_only(error) and self._connection is not None
        if self._connection is not None and self._connection.in_transaction:
            self._roll_back(self._connection)
        # A disk that stays full must not fill the memory.
        self._contents.drop_unwritten(MOST_UNWRITTEN, UNWRITABLE)

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
            waiting = None if self._last is None else self._last.waiting
            self._rebuild = rebuilt(self._path, self._servo, self._contents, waiting, MOST_UNWRITTEN)
            self._last = None
        rebuild, lost = self._rebuild
        try:
            aside = rebuild.rename()
        except OSError as error:  # a read-only disk: the next try renames it only
            self.trouble = str(error)
            return
        self._rebuild = None
        self.salvages.append(Salvage(aside, len(rebuild.found.windows), lost))
        self.flush()

    def _read(self, text: str, values: tuple[Any, ...]) -> list[Any]:
        try:
            return [] if self._connection is None else self._connection.execute(text, values).fetchall()
        except sqlite3.Error as error:
            self._failed(error)
            return []
