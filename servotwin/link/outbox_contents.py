"""Contents of an outbox on disk, as memory knows them, and the changes that are not on the disk yet.

The contents hold the index of the windows, not the windows. Every statement may be repeated, so that a transaction
whose outcome is not known is simply written again.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from servotwin.link.outbox import FULL, Dropped, Key, letter_digest
from servotwin.link.outbox_index import AcknowledgedWindows, Entry, excess, is_uninformative
from servotwin.link.salvage import Row, Salvaged
from servotwin.link.sqlite_file import (
    ACKNOWLEDGE,
    AGAIN,
    ASKED_FOR,
    COUNT,
    DELETE,
    INSERT,
    NOTE,
    POST,
    TAKE,
    Statement,
)

DROPPED = "dropped: "
BROKEN, UNWRITABLE = "outbox broken", "disk not writable"


class OutboxContents:
    """Index of windows, letters, counts and values; whoever uses it locks it and writes its changes.

    Parameters
    ----------
    kept : AcknowledgedWindows
        Windows that stay after their acknowledgement.

    Attributes
    ----------
    index : dict of Key to Entry
        Windows that wait, in the order of age.
    letters : dict
        Digests, in the order of age.
    counts : Counter
    notes : dict of str to bytes
    unwritten : dict of tuple to Statement
        Changes that are not on the disk, in the order in which they were made; one for each thing that is changed.
    """

    def __init__(self, kept: AcknowledgedWindows) -> None:
        self._kept = kept
        self.index: dict[Key, Entry] = {}
        self.letters: dict[bytes, None] = {}
        self.counts: Counter[str] = Counter()
        self.notes: dict[str, bytes] = {}
        self.unwritten: dict[tuple[Any, ...], Statement] = {}

    def has_window(self, key: Key) -> bool:
        """True for a window that waits, and for one that was acknowledged and is kept."""
        return key in self.index or key in self._kept.entries

    def pending(self) -> list[Key]:
        """Keys of all windows, oldest first; those that are sent once more come last."""
        return sorted(self.index, key=lambda key: self.index[key].again)

    def oldest(self) -> Key | None:
        """First key of `pending`; None: there is none."""
        # Without making the list: it is asked for with each window that is sent, and there may be thousands.
        fresh = (key for key, entry in self.index.items() if not entry.again)
        return next(fresh, None) or next(iter(self.index), None)

    def newest(self) -> Key | None:
        """Key of the newest window that the twin has never acknowledged; None: there is none."""
        return next((key for key, entry in reversed(self.index.items()) if not entry.again), None)

    def add_window(self, key: Key, reason: str, encoding: str, body: bytes) -> None:
        """Add the newest window."""
        self.index[key] = Entry(len(body), is_uninformative(reason))
        self.unwritten["window", key] = Statement(INSERT, (*key, reason, encoding, body))

    def acknowledge(self, key: Key) -> None:
        """Keep an acknowledged window for a while; one that is not on the disk yet is forgotten."""
        if ("window", key) in self.unwritten or not self._kept.limits.bytes:
            self.forget(key)
            return
        entry, now = self.index.pop(key), self._kept.now()
        self.unwritten["acknowledged", key] = Statement(ACKNOWLEDGE, (*key, now))
        for old in self._kept.add(key, entry.size, now):
            self.unwritten["window", old] = Statement(DELETE, old)
            self.unwritten["acknowledged", old] = Statement(ASKED_FOR, old)

    def put_back(self, wanted: Callable[[str, int], bool]) -> list[Key]:
        """Let acknowledged windows for which `wanted(boot, sequence)` is true wait once more, after all others."""
        found = [key for key in self._kept.entries if wanted(*key)]
        for key in found:
            self.index[key] = Entry(self._kept.take(key), uninformative=False, again=True)
            self.unwritten["acknowledged", key] = Statement(ACKNOWLEDGE, (*key, AGAIN))
        return found

    def forget(self, key: Key, reason: str | None = None) -> None:
        """Remove a window; count it as dropped where there is a reason."""
        entry = self.index.pop(key, None)
        if entry is not None and entry.again:
            self.unwritten["acknowledged", key] = Statement(ASKED_FOR, key)
        self.unwritten["window", key] = Statement(DELETE, key)
        if reason is not None:
            self.count_dropped(reason)

    def make_room(self, windows: int, size: int) -> list[Dropped]:
        """Drop windows until at most `windows` wait, of `size` bytes; return them.

        One that was acknowledged is kept as it was before.
        """
        drops = list[Dropped]()
        for key in excess(self.index, windows, size):
            if self.index[key].again:
                self.acknowledge(key)
            else:
                self.forget(key, FULL)
                drops.append(Dropped(key, FULL))
        return drops

    def drop_unwritten(self, most: int, reason: str) -> None:
        """Drop the oldest windows that are not on the disk, until they have at most `most` bytes."""
        windows = [(key, statement) for key, statement in self.unwritten.items() if statement.text == INSERT]
        size = sum(len(statement.values[4]) for _, statement in windows)
        for (_, key), statement in windows:
            if size <= most:
                return
            size -= len(statement.values[4])
            self.forget(key, reason)

    def add_letter(self, body: bytes) -> None:
        """Add the newest letter; equal letters are one."""
        digest = letter_digest(body)
        self.letters[digest] = None
        self.unwritten["letter", digest] = Statement(POST, (digest, body))

    def take_letter(self, digest: bytes) -> bool:
        """Remove a letter; False when it was not there."""
        known = digest in self.letters
        self.letters.pop(digest, None)
        self.unwritten["letter", digest] = Statement(TAKE, (digest,))
        return known

    def count(self, what: str, number: int = 1) -> None:
        """Add to a count."""
        if number > 0:
            self.set_number(what, self.counts[what] + number)

    def count_dropped(self, reason: str, number: int = 1) -> None:
        """Count dropped windows or letters under a reason."""
        self.count(DROPPED + reason, number)

    def set_number(self, name: str, number: int) -> None:
        """Set a count."""
        self.counts[name] = number
        self.unwritten["count", name] = Statement(COUNT, (name, number))

    def set_value(self, name: str, value: bytes) -> None:
        """Set bytes under a name."""
        self.notes[name] = value
        self.unwritten["note", name] = Statement(NOTE, (name, value))

    def load(self, connection: sqlite3.Connection) -> None:
        """Load a file's contents; changes in memory, which are newer, take precedence."""
        windows = connection.execute("SELECT boot, sequence, reason, length(body) FROM windows ORDER BY place")
        stored = {(boot, number): Entry(size, is_uninformative(reason)) for boot, number, reason, size in windows}
        letters = [digest for (digest,) in connection.execute("SELECT digest FROM letters ORDER BY place")]
        counts: dict[str, int] = dict(connection.execute("SELECT what, number FROM counts").fetchall())
        acknowledged = connection.execute("SELECT boot, sequence, at FROM acknowledged").fetchall()
        times = {(boot, number): at for boot, number, at in acknowledged if (boot, number) in stored}
        stored |= {key: stored[key]._replace(again=True) for key, at in times.items() if at == AGAIN}
        self._kept.load((key, stored.pop(key).size, at) for key, at in times.items() if at != AGAIN)
        # Windows of the file first: they are older, and the index is in the order of age.
        self.index = {
            **{key: entry for key, entry in stored.items() if ("window", key) not in self.unwritten},
            **self.index,
        }
        self.letters = {**{each: None for each in letters if ("letter", each) not in self.unwritten}, **self.letters}
        self.counts = Counter(counts) | self.counts
        self.notes = dict(connection.execute("SELECT name, value FROM notes").fetchall()) | self.notes

    def replace(self, found: Salvaged, rows: Sequence[Row], in_memory: set[Key]) -> None:
        """Take over what was found in a corrupt file, in place of what that file held.

        Parameters
        ----------
        found : Salvaged
            Letters, counts and values.
        rows : sequence of Row
            Windows that are in no new file.
        in_memory : set of Key
            Windows that the corrupt file never had.
        """
        unwritten: dict[tuple[Any, ...], Statement] = {
            ("window", (row[1], row[2])): Statement(INSERT, row[1:]) for row in rows
        }
        letters = {digest: body for digest, body in found.letters if ("letter", digest) not in self.unwritten}
        unwritten |= {("letter", digest): Statement(POST, (digest, body)) for digest, body in letters.items()}
        self.index = {
            **{(row[1], row[2]): Entry(len(row[5]), is_uninformative(row[3])) for row in rows},
            **{key: entry for key, entry in self.index.items() if key in in_memory},
        }
        known = {digest for digest in self.letters if ("letter", digest) in self.unwritten}
        self.letters = dict.fromkeys([*letters, *(digest for digest in self.letters if digest in known)])
        self.unwritten = unwritten | self.unwritten
        self.counts = Counter(found.counts) | self.counts
        self.notes = found.notes | self.notes
        self._kept.load(())

    def write_all_numbers(self) -> None:
        """Have all counts and values written, as into a new file."""
        for name, number in self.counts.items():
            self.set_number(name, number)
        for name, value in self.notes.items():
            self.set_value(name, value)
