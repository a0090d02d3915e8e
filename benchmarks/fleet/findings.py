"""Results of a run in the store: waiting times of windows, and the evidence from them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

from benchmarks.fleet.plan import shares


class ProcessedWork(NamedTuple):
    """Work on the windows that came within some time.

    Attributes
    ----------
    windows, undone : int
        Windows that came, and those of them without an outcome at the time of the query.
    age : tuple of float
        s from a window's commit to that of its outcome: median, 99 % and largest.
    glanced, estimated : tuple of float
        The same of windows for which a glance did while they were the newest, and of those that were estimated.
    """

    windows: int
    undone: int
    age: tuple[float, float, float]
    glanced: tuple[float, float, float] = (0.0, 0.0, 0.0)
    estimated: tuple[float, float, float] = (0.0, 0.0, 0.0)


class BacklogWork(NamedTuple):
    """Work on the windows of an outage.

    Attributes
    ----------
    windows, undone : int
        Windows that came, and those of them without an outcome at the time of the query.
    came, processed : tuple of float
        s from the return of the link until their commit, and until their outcome: median, 99 % and largest.
    """

    windows: int = 0
    undone: int = 0
    came: tuple[float, float, float] = (0.0, 0.0, 0.0)
    processed: tuple[float, float, float] = (0.0, 0.0, 0.0)


_JUDGED = (
    " AND EXISTS (SELECT 1 FROM evidence WHERE message = messages.id"
    " AND (kind = 'estimate' OR status = 'nothing moved'))"
)


@contextmanager
def reading(file: Path) -> Iterator[sqlite3.Connection]:
    """Open the store's file read-only, beside the twin."""
    with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True, timeout=60.0)) as connection:
        yield connection


def waiting(connection: sqlite3.Connection, now: float) -> tuple[int, float]:
    """Windows and letters that wait, and the age (s) of the oldest."""
    query = "SELECT count(*) FROM messages WHERE done IS NULL AND kind != 'verification'"
    (count,) = connection.execute(query).fetchone()
    (oldest,) = connection.execute("SELECT min(ready) FROM twins WHERE ready IS NOT NULL").fetchone()
    return int(count), 0.0 if oldest is None else max(0.0, now - float(oldest))


def stored(connection: sqlite3.Connection) -> int:
    """Windows that were ever committed."""
    (count,) = connection.execute("SELECT coalesce(sum(windows), 0) FROM twins").fetchone()
    return int(count)


def done(connection: sqlite3.Connection, since: float, until: float) -> ProcessedWork:
    """Query the work on the windows that came between two times (s since the epoch)."""
    query = (
        "SELECT received, done, EXISTS (SELECT 1 FROM evidence WHERE message = messages.id AND kind = 'estimate'), "
        "EXISTS (SELECT 1 FROM evidence WHERE message = messages.id AND status = 'nothing moved') "
        "FROM messages WHERE kind = 'window' AND received >= ? AND received < ?"
    )
    rows = connection.execute(query, (since, until)).fetchall()
    ages = [(end - begin, estimated, alike) for begin, end, estimated, alike in rows if end is not None]
    return ProcessedWork(
        len(rows),
        len(rows) - len(ages),
        shares([age for age, _, _ in ages]),
        shares([age for age, _, alike in ages if alike]),
        shares([age for age, estimated, _ in ages if estimated]),
    )


def fresh(connection: sqlite3.Connection, start: float, returned: float, judged: bool = False) -> list[float]:
    """Time from the return of the link, at `returned` (s since the epoch), until a window of each servo has an outcome
    that starts at `start` (s of sample time) or later; rising, s.

    `judged`: a window that was estimated or in which nothing had moved, not one that a newer one has overtaken.
    """
    query = "SELECT min(done) FROM messages WHERE kind = 'window' AND start >= ? AND done IS NOT NULL"
    rows = connection.execute(query + (_JUDGED if judged else "") + " GROUP BY servo", (start,))
    return sorted(float(at) - returned for (at,) in rows)


def worked_off(connection: sqlite3.Connection, begin: float, end: float, returned: float) -> BacklogWork:
    """Query the windows of an outage, which start from `begin` to `end` (s of sample time)."""
    query = "SELECT received, done FROM messages WHERE kind = 'window' AND start >= ? AND start < ?"
    rows = connection.execute(query, (begin, end)).fetchall()
    came = shares([float(at) - returned for at, _ in rows])
    done_at = shares([float(at) - returned for _, at in rows if at is not None])
    return BacklogWork(len(rows), sum(at is None for _, at in rows), came, done_at)


def made(connection: sqlite3.Connection, since: float) -> dict[str, int]:
    """Number of records of each kind of evidence since a time (s since the epoch)."""
    query = "SELECT kind, count(*) FROM evidence WHERE created >= ? GROUP BY kind"
    return {str(kind): int(count) for kind, count in connection.execute(query, (since,))}


def failures(connection: sqlite3.Connection) -> list[str]:
    """Reasons of failed work, a few of them."""
    query = "SELECT DISTINCT status FROM evidence WHERE status LIKE 'failed%' LIMIT 3"
    return [str(status) for (status,) in connection.execute(query)]
