"""Windows kept until the twin has them: the protocol, and the in-memory one."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from servotwin.errors import InvalidInput
from servotwin.messages import Window

Key = tuple[str, int]
"""(boot, sequence): which window of this servo."""

FULL = "outbox full"


class Dropped(NamedTuple):
    """A window that was given up, and why."""

    key: Key
    reason: str


class Outbox(Protocol):
    """What the session needs from a store of unacknowledged windows; it is bounded and counts what it drops."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows given up so far, by reason."""

    def put(self, window: Window) -> Sequence[Dropped]:
        """Keep a window; returns what had to go to make room, oldest first."""

    def get(self, key: Key) -> Window:
        """The window; KeyError when it is not (or no longer) kept."""

    def remove(self, key: Key) -> bool:
        """Forget an acknowledged window; False when it was not there."""

    def pending(self) -> Sequence[Key]:
        """Keys of everything kept, oldest first."""


class MemoryOutbox:
    """An outbox that lives as long as the process.

    Parameters
    ----------
    capacity : int
        Windows kept at most; the oldest are dropped first.
    """

    def __init__(self, capacity: int = 256) -> None:
        if capacity < 1:
            raise InvalidInput(f"outbox capacity = {capacity!r} windows: must be at least 1")
        self._capacity = capacity
        self._windows: dict[Key, Window] = {}
        self._dropped: Counter[str] = Counter()
        self.recently_dropped: deque[Dropped] = deque(maxlen=1000)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Windows given up so far, by reason."""
        return self._dropped

    def put(self, window: Window) -> list[Dropped]:
        """Keep a window; returns what had to go to make room, oldest first."""
        self._windows[window.boot, window.sequence] = window
        excess = len(self._windows) - self._capacity
        drops = [Dropped(key, FULL) for key in list(self._windows)[: max(0, excess)]]
        for drop in drops:
            del self._windows[drop.key]
            self._dropped[drop.reason] += 1
        self.recently_dropped.extend(drops)
        return drops

    def get(self, key: Key) -> Window:
        """The window; KeyError when it is not (or no longer) kept."""
        return self._windows[key]

    def remove(self, key: Key) -> bool:
        """Forget an acknowledged window; False when it was not there."""
        return self._windows.pop(key, None) is not None

    def pending(self) -> list[Key]:
        """Keys of everything kept, oldest first."""
        return list(self._windows)
