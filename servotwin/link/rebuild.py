"""A new outbox beside a corrupt one: windows go from file to file, one at a time, so that memory stays small.

The new file is complete before it takes the other's name. So an edge that is killed meanwhile finds the corrupt file
again, or the new one.
"""

from __future__ import annotations

import heapq
import os
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from pathlib import Path

from servotwin.link.outbox import Key
from servotwin.link.outbox_contents import BROKEN, UNWRITABLE, OutboxContents
from servotwin.link.salvage import Row, Salvaged, salvage
from servotwin.link.sqlite_file import BESIDE, INSERT, INSERT_AT, NOTE, SERVO, Statement, connect, put_aside

_BATCH = 4_000_000
"""Bytes of windows in one transaction."""
_LARGEST_PLACE = 2**53
"""A damaged page may hold any number; SQLite gives no place after its largest one."""


class Rebuild:
    """Windows that were read of a corrupt outbox: in a new file, or in memory where there is no room for that.

    Parameters
    ----------
    path : Path
        The corrupt file.
    known : set of Key
        Windows that are left out: memory has them.
    most : int
        Bytes of windows in memory; the newest ones stay.

    Attributes
    ----------
    found : Salvaged
        Its windows are those that are rescued.
    in_memory : list of Row
        Windows, oldest first, where there was no room for a new file.
    dropped : set of Key
        Windows for which memory had no room either.
    """

    def __init__(self, path: Path, known: set[Key], most: int) -> None:
        self._path, self._new = path, new_of(path)
        self.in_memory: list[Row] = []
        self.dropped: set[Key] = set()
        try:
            self.found = self._to_file(known)
        except OSError:
            self.discard()
            self.found = self._to_memory(known, most)
        self.found.windows -= known | self.dropped

    def complete(self, statements: Iterable[Statement]) -> None:
        """Write the last changes into the new file, where there is one; they may fail, and are then written later."""
        if self._new.exists():
            with suppress(sqlite3.Error, OSError), closing(_open(self._new)) as connection:
                connection.execute("BEGIN IMMEDIATE")
                for statement in statements:
                    connection.execute(statement.text, statement.values)
                connection.execute("COMMIT")

    def rename(self) -> Path:
        """Put the corrupt file aside and the new one, if there is one, in its place; return the former's new path.

        Raises
        ------
        OSError
        """
        aside = put_aside(self._path, "broken")
        adopt(self._path)
        return aside

    def discard(self) -> None:
        """Remove the new file."""
        for end in ("", "-journal", *BESIDE):
            with suppress(OSError):
                self._new.with_name(self._new.name + end).unlink(missing_ok=True)

    def _to_file(self, known: set[Key]) -> Salvaged:
        self.discard()  # of an edge that was killed
        with closing(_NewFile(self._new)) as file:
            found = salvage(self._path, _others(known, file.put))
            file.commit()
            return found

    def _to_memory(self, known: set[Key], most: int) -> Salvaged:
        newest = _NewestWindows(most)
        found = salvage(self._path, _others(known, newest.put))
        self.in_memory, self.dropped = sorted(newest.rows), newest.dropped
        return found


def rebuilt(path: Path, servo: str, contents: OutboxContents, waiting: int | None, most: int) -> tuple[Rebuild, int]:
    """Read a corrupt file, and take over its letters, counts and values; what is in memory is newer.

    Parameters
    ----------
    path : Path
    servo : str
        Whose outbox it should be.
    contents : OutboxContents
    waiting : int or None
        Windows that waited by the last status, where the file was not open since.
    most : int
        As for `Rebuild`.

    Returns
    -------
    Rebuild, int
        To be renamed; and the number of windows that are lost, which is counted.
    """
    in_memory = {key for kind, key in contents.unwritten if kind == "window"}
    rebuild = Rebuild(path, in_memory, most)
    found, known = rebuild.found, rebuild.found.windows | rebuild.dropped | in_memory
    owner = found.notes.get(SERVO, servo.encode())
    if owner != servo.encode():
        rebuild.complete([Statement(NOTE, (SERVO, owner))])  # it is put aside, too, when it is opened
        return rebuild, len(found.lost)
    # Known by name: from memory where the file was open before, and from what is left of the file.
    lost = (contents.index.keys() | found.lost) - known
    # The number of the last status is old by up to a second: it counts only where the names are not known.
    unnamed = not (contents.index or found.lost_is_complete)
    number = max(len(lost), (waiting or 0) - len(known - in_memory) if unnamed else 0)
    contents.replace(found, rebuild.in_memory, in_memory)
    contents.count_dropped(BROKEN, number)
    contents.count_dropped(UNWRITABLE, len(rebuild.dropped))
    contents.count(BROKEN)
    contents.write_all_numbers()
    rebuild.complete(contents.unwritten.values())
    return rebuild, number


def adopt(path: Path) -> None:
    """Give an outbox's name to the new file that was made in its place, where no file has it.

    Raises
    ------
    OSError
    """
    new = new_of(path)
    if new.exists() and not path.exists():
        for end in BESIDE:  # of the former file, whose rows the new one has: SQLite would apply that log to it
            path.with_name(path.name + end).unlink(missing_ok=True)
        new.rename(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # what is confirmed from now on is in this file
        finally:
            os.close(folder)


def new_of(path: Path) -> Path:
    """Name of the file that is made in an outbox's place."""
    return path.with_name(f"{path.name}.new")


def _others(known: set[Key], put: Callable[[Row], None]) -> Callable[[Row], None]:
    def give(row: Row) -> None:
        if (row[1], row[2]) not in known:
            put(row)

    return give


def _open(path: Path) -> sqlite3.Connection:
    connection = connect(path, check=False)
    connection.execute("PRAGMA journal_mode = DELETE")  # no log, which would have to be renamed as well
    return connection


class _NewFile:
    """A file to which windows are added; all errors are OSError, since those of SQLite are the corrupt file's."""

    def __init__(self, path: Path) -> None:
        try:
            self._connection = _open(path)
            self._connection.execute("BEGIN IMMEDIATE")
        except sqlite3.Error as error:
            raise OSError(str(error)) from None
        self._bytes = 0

    def put(self, row: Row) -> None:
        """Add a window, at its place."""
        try:
            at = self._connection.execute(INSERT_AT, row) if row[0] < _LARGEST_PLACE else None
            if at is None or at.rowcount == 0:  # its place is given to another
                self._connection.execute(INSERT, row[1:])
        except sqlite3.Error as error:
            raise OSError(str(error)) from None
        self._bytes += len(row[5])
        if self._bytes > _BATCH:
            self.commit()

    def commit(self) -> None:
        """Write what was added to the disk."""
        try:
            self._connection.execute("COMMIT")
            self._connection.execute("BEGIN IMMEDIATE")
        except sqlite3.Error as error:
            raise OSError(str(error)) from None
        self._bytes = 0

    def close(self) -> None:
        """Close the file; what is not committed is gone."""
        self._connection.close()


class _NewestWindows:
    """The newest windows, as many as memory may hold."""

    def __init__(self, most: int) -> None:
        self._most, self._bytes = most, 0
        self.rows: list[Row] = []
        self.dropped = set[Key]()

    def put(self, row: Row) -> None:
        """Add a window, and drop the oldest where there is no room."""
        heapq.heappush(self.rows, row)
        self._bytes += len(row[5])
        while self._bytes > self._most:
            _, boot, sequence, *_, body = heapq.heappop(self.rows)
            self._bytes -= len(body)
            self.dropped.add((boot, sequence))
