"""Index of an outbox on disk: which windows are dropped first, and which stay after their acknowledgement.

A twin restored from a backup asks for acknowledged windows again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from operator import itemgetter
from typing import NamedTuple

from servotwin.link.outbox import Key


class AcknowledgedLimits(NamedTuple):
    """Limits of the acknowledged windows: bytes of all, and s of running time since; 0 bytes: none stay."""

    bytes: int
    seconds: float


class LastStatus(NamedTuple):
    """Numbers of an edge's last status, which may be up to a second older than its files.

    Attributes
    ----------
    waiting : int
        Windows that waited.
    stored : int
        Windows that the file had stored so far.
    """

    waiting: int = 0
    stored: int = 0


class _Kept(NamedTuple):
    """An acknowledged window: its size in bytes, and when it was acknowledged, s of running time."""

    size: int
    at: float


@dataclass(slots=True)
class AcknowledgedWindows:
    """Index of acknowledged windows, the oldest acknowledgement first.

    Their time is the time for which link processes of the edge have run: each goes on where the newest acknowledgement
    of the file stands. A clock that is set, or wrong at a start, changes nothing.

    Parameters
    ----------
    limits : AcknowledgedLimits
    clock : callable
        Monotonic, s.
    """

    limits: AcknowledgedLimits
    clock: Callable[[], float] = time.monotonic
    entries: dict[Key, _Kept] = field(default_factory=dict)
    _bytes: int = 0
    _zero: float = 0.0

    def now(self) -> float:
        """Running time, s."""
        return self._zero + self.clock()

    def load(self, stored: Iterable[tuple[Key, int, float]]) -> None:
        """Load the index of a file: keys, sizes and times."""
        rows = sorted(stored, key=lambda row: row[2])
        self.entries = {key: _Kept(size, at) for key, size, at in rows}
        self._bytes = sum(size for _, size, _ in rows)
        self._zero = (rows[-1][2] if rows else 0.0) - self.clock()

    def take(self, key: Key) -> int:
        """Forget a window; return its size."""
        size = self.entries.pop(key).size
        self._bytes -= size
        return size

    def add(self, key: Key, size: int, now: float) -> list[Key]:
        """Add a window; return those that are over the limits now, which are forgotten."""
        self.entries[key] = _Kept(size, now)
        self._bytes += size
        gone = list[Key]()
        while self.entries:
            oldest, entry = next(iter(self.entries.items()))
            if self._bytes <= self.limits.bytes and now - entry.at <= self.limits.seconds:
                break
            self.take(oldest)
            gone.append(oldest)
        return gone


_UNINFORMATIVE = ("periodic",)
"""First words of the reasons of windows that are dropped first."""


_SIZE = itemgetter(0)


class Entry(NamedTuple):
    """Entry of the index for a window.

    Attributes
    ----------
    size : int
        bytes.
    uninformative : bool
        Its reason is one of `_UNINFORMATIVE`.
    again : bool
        It was acknowledged, and is sent once more because the twin has asked for it.
    """

    size: int
    uninformative: bool
    again: bool = False


def is_uninformative(reason: str) -> bool:
    """True where a window with this reason is dropped before others."""
    return reason.partition(" ")[0].rstrip(",:;") in _UNINFORMATIVE


def excess(index: Mapping[Key, Entry], windows: int, size: int) -> list[Key]:
    """Choose keys to drop until at most `windows` windows and `size` bytes are left; `index` is in order of age.

    Windows that the twin had acknowledged go first, then uninformative ones.
    """
    over, heavy = len(index) - windows, sum(map(_SIZE, index.values())) - size
    dropped: list[Key] = []
    if over <= 0 and heavy <= 0:  # before it sorts thousands, with each window that is put
        return dropped
    # Stable: by age within each.
    for key, entry in sorted(index.items(), key=lambda item: (not item[1].again, not item[1].uninformative)):
        if over <= 0 and heavy <= 0:
            break
        dropped.append(key)
        over, heavy = over - 1, heavy - entry.size
    return dropped
