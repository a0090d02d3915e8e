"""Outbox of an edge, which holds windows and letters until the twin acknowledges them: protocol and memory outbox.

A letter is an encoded hello, receipt, fallback or answer. `servotwin.link.sqlite_outbox` is the outbox on disk.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import NamedTuple, Protocol

from servotwin.errors import InvalidInput
from servotwin.link.transport import Parcel
from servotwin.messages import WindowMessage, encode
from servotwin.messages.codec import deflated

Key = tuple[str, int]
"""(boot, sequence): identifies a window of a servo."""

FULL = "outbox full"


class Dropped(NamedTuple):
    """A window that was dropped, and the reason."""

    key: Key
    reason: str


class Outbox(Protocol):
    """Bounded store of unacknowledged messages, which counts the windows that it drops."""

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of windows dropped so far, by reason."""

    def put(self, window: WindowMessage) -> Sequence[Dropped]:
        """Store a window; return the windows dropped to make room, oldest first."""

    def get(self, key: Key) -> WindowMessage:
        """Return a window; KeyError when it is not stored (any more)."""

    def parcel(self, key: Key) -> Parcel:
        """Return a window as it is sent; KeyError when it is not stored (any more)."""

    def remove(self, key: Key) -> bool:
        """Remove an acknowledged window; False when it was not there."""

    def drop(self, key: Key, reason: str) -> None:
        """Drop a window and count it under a reason."""

    def count_dropped(self, reason: str) -> None:
        """Count a window that was dropped before it was put here."""

    @property
    def waiting(self) -> int:
        """Number of windows."""

    def pending(self) -> Sequence[Key]:
        """Keys of all windows, oldest first; this takes its time where they are many."""

    def oldest(self) -> Key | None:
        """Key of the first window of `pending`; None: there is none."""

    def newest(self) -> Key | None:
        """Key of the newest window that the twin has never acknowledged; None: there is none."""

    def put_letter(self, body: bytes) -> None:
        """Store a letter (an encoded message); equal letters are stored once."""

    def letters(self) -> Sequence[bytes]:
        """Digests of all letters, oldest first."""

    def letter(self, digest: bytes) -> Parcel:
        """Return a letter as it is sent; KeyError when it is not stored."""

    def remove_letter(self, digest: bytes) -> bool:
        """Remove a letter; False when it was not there."""

    def set_value(self, name: str, value: bytes) -> None:
        """Store bytes under a name."""

    def value(self, name: str) -> bytes | None:
        """Return the bytes stored under a name; None: there are none."""


class MemoryOutbox:
    """An outbox in memory, which ends with the process.

    Parameters
    ----------
    capacity : int
        Largest number of windows; the oldest are dropped first.
    servo : str
        Name in the parcels; "" where no parcels are made.
    """

    def __init__(self, capacity: int = 256, servo: str = "") -> None:
        if capacity < 1:
            raise InvalidInput(f"outbox capacity = {capacity!r} windows: must be at least 1")
        self._capacity, self._servo = capacity, servo
        self._windows: dict[Key, WindowMessage] = {}
        self._letters: dict[bytes, bytes] = {}
        self._values: dict[str, bytes] = {}
        self._dropped: Counter[str] = Counter()
        self.recently_dropped: deque[Dropped] = deque(maxlen=1000)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of windows dropped so far, by reason."""
        return self._dropped

    def put(self, window: WindowMessage) -> list[Dropped]:
        """Store a window; return the windows dropped to make room, oldest first."""
        self._windows[window.boot, window.sequence] = window
        excess = len(self._windows) - self._capacity
        drops = [Dropped(key, FULL) for key in list(self._windows)[: max(0, excess)]]
        for each in drops:
            self.drop(*each)
        return drops

    def get(self, key: Key) -> WindowMessage:
        """Return a window; KeyError when it is not stored (any more)."""
        return self._windows[key]

    def parcel(self, key: Key) -> Parcel:
        """Return a window as it is sent; KeyError when it is not stored (any more)."""
        return Parcel(self._servo, *deflated(encode(self._windows[key])), *key)

    def remove(self, key: Key) -> bool:
        """Remove an acknowledged window; False when it was not there."""
        return self._windows.pop(key, None) is not None

    def drop(self, key: Key, reason: str) -> None:
        """Drop a window and count it under a reason."""
        if self.remove(key):
            self.count_dropped(reason)
            self.recently_dropped.append(Dropped(key, reason))

    def count_dropped(self, reason: str) -> None:
        """Count a window that was dropped before it was put here."""
        self._dropped[reason] += 1

    @property
    def waiting(self) -> int:
        """Number of windows."""
        return len(self._windows)

    def pending(self) -> list[Key]:
        """Keys of all windows, oldest first."""
        return list(self._windows)

    def oldest(self) -> Key | None:
        """Key of the oldest window; None: there is none."""
        return next(iter(self._windows), None)

    def newest(self) -> Key | None:
        """Key of the newest window; None: there is none."""
        return next(reversed(self._windows), None)

    def put_letter(self, body: bytes) -> None:
        """Store a letter; equal letters are stored once."""
        self._letters[letter_digest(body)] = body

    def letters(self) -> list[bytes]:
        """Digests of all letters, oldest first."""
        return list(self._letters)

    def letter(self, digest: bytes) -> Parcel:
        """Return a letter as it is sent; KeyError when it is not stored."""
        return Parcel(self._servo, self._letters[digest])

    def remove_letter(self, digest: bytes) -> bool:
        """Remove a letter; False when it was not there."""
        return self._letters.pop(digest, None) is not None

    def set_value(self, name: str, value: bytes) -> None:
        """Store bytes under a name."""
        self._values[name] = value

    def value(self, name: str) -> bytes | None:
        """Return the bytes stored under a name; None: there are none."""
        return self._values.get(name)


def letter_digest(body: bytes) -> bytes:
    """Compute the digest that identifies a letter."""
    return blake2b(body, digest_size=16).digest()
