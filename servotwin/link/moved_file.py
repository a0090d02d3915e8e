"""An open outbox whose file or log was deleted, moved or replaced: all that it holds goes into a file in its place.

The process still has the former files, whoever took their names; without that they would be gone when it ends.
"""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

from servotwin.link.rebuild import adopt, new_of
from servotwin.link.sqlite_file import make_private, put_aside
from servotwin.runtime.sqlite_damage import is_damage


class MovedFiles(NamedTuple):
    """Files that were no longer in their places.

    Attributes
    ----------
    files : tuple of str
        Their names.
    aside : path or None
        New name of the file that was found in the outbox's place; None: there was none.
    """

    files: tuple[str, ...]
    aside: Path | None


def write_anew(connection: sqlite3.Connection, path: Path, changed: Sequence[Path]) -> MovedFiles:
    """Write all that a connection reads into a file at `path`, and close the connection.

    An edge that is killed meanwhile finds the whole file when it is started again, or none.

    Raises
    ------
    sqlite3.Error
        The former file is corrupt.
    OSError
        There is no room, no folder, or no right; the connection is open then, and reads on.
    """
    names = tuple(place.name for place in changed)
    try:
        aside = _write(connection, path) if path in changed else None
        if path not in changed:
            _empty_log(connection)  # into the database, which is in its place
            connection.close()
    except (sqlite3.Error, OSError) as error:
        if isinstance(error, sqlite3.Error) and is_damage(error):
            raise
        why = getattr(error, "strerror", None) or str(error)
        moved = "deleted, moved or replaced while the outbox was open"
        raise OSError(f"{' and '.join(names)}: {moved}, and not written anew yet ({why})") from None
    return MovedFiles(names, aside)


def _write(connection: sqlite3.Connection, path: Path) -> Path | None:
    _require_room(connection, path.parent)
    copy = path.with_name(f"{path.name}.copy")
    with suppress(FileNotFoundError):
        copy.unlink()  # of an edge that was killed
    make_private(copy)
    with closing(sqlite3.connect(copy)) as target:
        connection.backup(target)
        target.execute("PRAGMA journal_mode = DELETE")  # no log, which would have to be renamed as well
    copy.rename(new_of(path))
    # Before the connection closes: SQLite removes the log of that name then, whosever it is.
    aside = put_aside(path, "another") if path.exists() else None
    with suppress(sqlite3.Error):
        _empty_log(connection)  # SQLite does not do it at the close of a file that was moved, which then lacks the rest
    connection.close()
    adopt(path)
    return aside


def _empty_log(connection: sqlite3.Connection) -> None:
    (busy, *_) = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    if busy:
        raise sqlite3.OperationalError("another program reads it")


def _require_room(connection: sqlite3.Connection, folder: Path) -> None:
    """Refuse to begin a copy that will not fit: it is tried again every second."""
    (pages,), (size,) = (connection.execute(f"PRAGMA {name}").fetchone() for name in ("page_count", "page_size"))
    if pages * size > shutil.disk_usage(folder).free:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
