"""Threads in which the event loop makes blocking calls of the store."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from servotwin.messages import Refusal
from servotwin.store.engine import ServoSetAside, StoreDamaged, StoreUnavailable
from servotwin.twin_service.limits import RequestRejected

_Result = TypeVar("_Result")
_THREADS = 4


class StoreExecutor:
    """Thread pool for calls of the store.

    Parameters
    ----------
    threads : int
    name : str
        Of the threads.
    note_damage : callable, optional
        Called with damage that a call found; by default it is kept as `damage`.

    Attributes
    ----------
    fault : str
        Why the last call failed; empty: it succeeded.
    damage : StoreDamaged or None
        Damage that a call found; None: none since it was last set so.
    """

    def __init__(
        self,
        threads: int = _THREADS,
        name: str = "store",
        note_damage: Callable[[StoreDamaged], None] | None = None,
    ) -> None:
        self._threads = ThreadPoolExecutor(threads, name)
        self._note_damage = note_damage or self.note_damage
        self._begun = dict[object, float]()
        self.fault = ""
        self.damage: StoreDamaged | None = None

    @property
    def waited(self) -> float:
        """Time for which the oldest call in progress has waited for its result, s; slow ones do not count."""
        return time.monotonic() - min(self._begun.values()) if self._begun else 0.0

    def note_damage(self, error: StoreDamaged) -> None:
        """Keep damage that a call found, here or in other threads."""
        self.damage = error

    async def run(self, call: Callable[[], _Result], slow: bool = False) -> _Result:
        """Run a call in a thread; raises what it raises, above all StoreUnavailable. `slow`: it may take minutes."""
        mark = object()
        if not slow:
            self._begun[mark] = time.monotonic()
        try:
            result = await asyncio.get_running_loop().run_in_executor(self._threads, call)
        except ServoSetAside:
            raise  # the store itself works
        except StoreUnavailable as error:
            self.fault = str(error)
            if isinstance(error, StoreDamaged):
                self._note_damage(error)
            raise
        finally:
            self._begun.pop(mark, None)
        self.fault = ""
        return result

    def close(self) -> None:
        """Wait for the running calls."""
        self._threads.shutdown()


def unavailable(error: Exception, detail: str) -> RequestRejected:
    """Rejection for want of the store, in the words of `detail`, or in its own where a servo is set aside."""
    return RequestRejected(Refusal.UNAVAILABLE, str(error) if isinstance(error, ServoSetAside) else detail)
