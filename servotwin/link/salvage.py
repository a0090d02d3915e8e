"""Windows, letters and values that can still be read from a corrupt outbox, row by row around its damaged pages.

SQLite finds a row by its place through the table's tree: a damaged page hides the rows on it and below it, and no
others. The keys of all windows are in an index too, on other pages; so what is lost is known where that can be read.
The file is read where it is, with its write-ahead log, and not changed. Where that gives nothing, a copy is read, whose
first page that of an empty outbox replaces. Windows are handed on one by one: an outbox may be larger than the memory.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from servotwin.link.outbox import Key
from servotwin.link.sqlite_file import AGAIN, BESIDE, connect
from servotwin.messages import InvalidMessage, WindowMessage, decode
from servotwin.messages.codec import DEFLATE, MAX_BYTES, decompress

_MOST_PROBED = 20_000
"""Places that are looked up one by one between two damaged pages: four times as many as an outbox usually holds."""
_MOST_COPIED = 2_000_000_000
_WINDOWS = "SELECT place, boot, sequence, reason, encoding, body FROM windows"
_LETTERS = "SELECT place, digest, body FROM letters"
# By the order of the index, which holds all that is asked for: the table's pages are not read.
_KEYS = "SELECT boot, sequence FROM windows ORDER BY boot, sequence"
_ACKNOWLEDGED = f"SELECT boot, sequence FROM acknowledged WHERE at != {AGAIN}"


Row = tuple[int, str, int, str, str, bytes]
"""A window: place, which is larger for newer ones, boot, sequence, reason, encoding, body."""


class Salvage(NamedTuple):
    """A corrupt file that was put aside.

    Attributes
    ----------
    file : path
        Its new name.
    rescued, lost : int
        Windows that were read from it, and those known to be lost.
    """

    file: Path
    rescued: int
    lost: int


@dataclass(slots=True)
class Salvaged:
    """Rows that were read from a corrupt outbox.

    Attributes
    ----------
    windows : set of Key
        Windows that were read, and decode.
    letters : list of (bytes, bytes)
        Digests and bodies.
    counts, notes : dict
        As in the tables.
    lost : set of Key
        Windows that waited and cannot be read. More may be lost where the index is damaged too.
    lost_is_complete : bool
        The index and the acknowledgements are not damaged: no more are lost.
    """

    windows: set[Key] = field(default_factory=set)
    letters: list[tuple[bytes, bytes]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    notes: dict[str, bytes] = field(default_factory=dict)
    lost: set[Key] = field(default_factory=set)
    lost_is_complete: bool = False


def salvage(path: Path, give: Callable[[Row], None]) -> Salvaged:
    """Read what can be read of a corrupt outbox; `give` gets each window, once, in any order.

    Raises
    ------
    Exception
        What `give` raises.
    """
    found = Salvaged()
    # Nobody else has the file open. Without locks and shared memory SQLite writes nothing, and reads the log as well.
    _read_into(found, f"{path.absolute().as_uri()}?mode=ro&vfs=unix-none", give)
    if found.windows or found.lost or found.lost_is_complete:
        return found
    with _with_new_first_page(path) as copy:
        if copy is not None:
            _read_into(found, copy.absolute().as_uri(), give)
    return found


@contextmanager
def _with_new_first_page(path: Path) -> Iterator[Path | None]:
    """Yield a copy with another first page; None: there is no room for it."""
    with ExitStack() as stack:
        copy = None
        with suppress(OSError, sqlite3.Error):
            folder = stack.enter_context(tempfile.TemporaryDirectory(dir=path.parent, prefix=".salvage-"))
            made = Path(folder) / "copy.sqlite"
            _copy(path, made)
            _replace_first_page(made)
            copy = made
        yield copy


def _copy(path: Path, copy: Path) -> None:
    if path.stat().st_size > _MOST_COPIED:
        raise OSError(f"{path}: too large for a copy")
    for end in ("", *BESIDE[:1]):  # not the shared memory, which SQLite makes again from the log
        source = path.with_name(path.name + end)
        if source.exists():
            shutil.copyfile(source, copy.with_name(copy.name + end))


def _read_into(found: Salvaged, address: str, give: Callable[[Row], None]) -> None:
    with suppress(sqlite3.Error), closing(sqlite3.connect(address, uri=True)) as connection:
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()  # raises where the first page is damaged
        acknowledged = set(_rows(connection, _ACKNOWLEDGED))
        for row in _by_place(connection, _WINDOWS):
            key = boot, sequence = row[1], row[2]
            if key in acknowledged or key in found.windows:
                continue
            if _is_window(*row):
                found.windows.add(key)
                give(row)
            elif isinstance(boot, str) and isinstance(sequence, int):
                found.lost.add(key)
        found.lost |= set(_rows(connection, _KEYS)) - acknowledged
        found.lost -= found.windows
        letters = [row[1:] for row in sorted(_by_place(connection, _LETTERS), key=lambda row: row[0])]
        found.letters = [each for each in letters if all(isinstance(part, bytes) for part in each)]
        found.counts = {what: n for what, n in _rows(connection, "SELECT what, number FROM counts") if _is(n, int)}
        found.notes = {name: v for name, v in _rows(connection, "SELECT name, value FROM notes") if _is(v, bytes)}
        found.lost_is_complete = _is_whole(connection, _KEYS, _ACKNOWLEDGED)


def _is_whole(connection: sqlite3.Connection, *texts: str) -> bool:
    """Test whether queries can be read to their ends."""
    try:
        for text in texts:
            connection.execute(text).fetchall()
    except sqlite3.Error:
        return False
    return True


def _is(value: object, kind: type) -> bool:
    return isinstance(value, kind)


def _rows(connection: sqlite3.Connection, text: str) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a query up to the first damaged page."""
    with suppress(sqlite3.Error):
        yield from connection.execute(text)


def _by_place(connection: sqlite3.Connection, text: str) -> Iterator[tuple[Any, ...]]:
    """Yield a table's rows from both ends up to a damaged page, and what is between by places one by one."""
    first, last = 0, _last_place(connection, text)
    for row in _rows(connection, f"{text} ORDER BY place"):
        first = row[0]
        yield row
    for row in _rows(connection, f"{text} WHERE place > {first} ORDER BY place DESC"):
        last = row[0]
        yield row
    for place in range(first + 1, min(last, first + 1 + _MOST_PROBED)):
        yield from _rows(connection, f"{text} WHERE place = {place}")


def _last_place(connection: sqlite3.Connection, text: str) -> int:
    """Largest place that was ever given in the table of a query, and one more."""
    table = text.rpartition(" ")[2]
    [(place,), *_] = [*_rows(connection, f"SELECT seq FROM sqlite_sequence WHERE name = '{table}'"), (_MOST_PROBED,)]
    return int(place) + 1


def _is_window(place: object, boot: object, sequence: object, reason: object, encoding: object, body: object) -> bool:
    """True where a body is the window that its row says; its own checksum covers the samples."""
    if not (isinstance(place, int) and isinstance(reason, str) and isinstance(encoding, str)):
        return False
    if not isinstance(body, bytes):
        return False
    try:
        window = decode(decompress(body, encoding, MAX_BYTES) if encoding == DEFLATE else body)
    except (InvalidMessage, zlib.error):
        return False
    return isinstance(window, WindowMessage) and (window.boot, window.sequence) == (boot, sequence)


def _replace_first_page(copy: Path) -> None:
    """Replace the first page, with header and schema, by that of an empty outbox, whose tables begin alike."""
    empty = copy.with_name("empty.sqlite")
    with closing(connect(empty)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    page = bytearray(empty.read_bytes()[:4096])
    size = int.from_bytes(page[16:18], "big")
    with copy.open("r+b") as file:
        pages = file.seek(0, 2) // size
        page[28:32] = pages.to_bytes(4, "big")  # number of pages
        file.seek(0)
        file.write(page[:size])
