"""Threads in which the event loop makes blocking calls of the store."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from servotwin.store.engine import StoreUnavailable

_Result = TypeVar("_Result")
_THREADS = 4


class StoreExecutor:
    """Thread pool for calls of the store.

    Parameters
    ----------
    threads : int
    name : str
        Of the threads.

    Attributes
    ----------
    fault : str
        Why the last call failed; empty: it succeeded.
    """

    def __init__(self, threads: int = _THREADS, name: str = "store") -> None:
        self._threads = ThreadPoolExecutor(threads, name)
        self.fault = ""

    async def run(self, call: Callable[[], _Result]) -> _Result:
        """Run a call in a thread; raises what it raises, above all StoreUnavailable."""
        try:
            result = await asyncio.get_running_loop().run_in_executor(self._threads, call)
        except StoreUnavailable as error:
            self.fault = str(error)
            raise
        self.fault = ""
        return result

    def close(self) -> None:
        """Wait for the running calls."""
        self._threads.shutdown()
