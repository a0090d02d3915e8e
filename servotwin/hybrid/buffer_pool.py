"""Working memory that is used again: to get fresh memory from the system takes as long as a short run does."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

_Memory = TypeVar("_Memory")


class BufferPool(Generic[_Memory]):
    """Memory that nobody uses at present, by what it is good for; the oldest is dropped.

    Parameters
    ----------
    most : int
        Pieces that are kept.
    """

    def __init__(self, most: int) -> None:
        # Its operations are atomic, so that threads need no lock, which a fork could leave locked for ever.
        self._kept: deque[tuple[Hashable, _Memory]] = deque(maxlen=most)

    @contextmanager
    def lent(self, key: Hashable, make: Callable[[], _Memory]) -> Iterator[_Memory]:
        """Lend memory of a kind, made where there is none; it is as its last user left it, and nobody else's meanwhile.

        After an exception it is not kept.
        """
        memory = self._taken(key)
        if memory is None:
            memory = make()
        yield memory
        self._kept.append((key, memory))

    def _taken(self, key: Hashable) -> _Memory | None:
        # The newest first: the most of it is still in the caches.
        for _ in range(len(self._kept)):
            try:
                kept, memory = self._kept.pop()
            except IndexError:  # other threads took the rest
                return None
            if kept == key:
                return memory
            self._kept.appendleft((kept, memory))
        return None
