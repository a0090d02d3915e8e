"""The store, asked from the event loop: what blocks happens on a few threads beside it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from servotwin.store.engine import StoreUnavailable

_Result = TypeVar("_Result")
THREADS = 4


class Shelf:
    """Runs calls of the store on threads; knows whether the last one succeeded."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(THREADS, "store")
        self.fault = ""

    async def ask(self, call: Callable[[], _Result]) -> _Result:
        """What a call of the store gives; raises what it raises, StoreUnavailable above all."""
        try:
            found = await asyncio.get_running_loop().run_in_executor(self._threads, call)
        except StoreUnavailable as error:
            self.fault = str(error)
            raise
        self.fault = ""
        return found

    def close(self) -> None:
        """Wait for what is being asked."""
        self._threads.shutdown()
