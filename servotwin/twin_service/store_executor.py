"""Bridge between the event loop and threads: blocking calls of the store, and futures of the group commit."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from servotwin.store.engine import StoreUnavailable

_Result = TypeVar("_Result")
_THREADS = 4


class StoreExecutor:
    """Thread pool for calls of the store.

    Attributes
    ----------
    fault : str
        Why the last call failed; empty: it succeeded.
    """

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(_THREADS, "store")
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


class FutureBridge:
    """Wraps futures of threads as futures of the event loop.

    Unlike asyncio.wrap_future it wakes the loop once for all futures that one commit resolves.
    """

    def __init__(self) -> None:
        self._done: deque[tuple[asyncio.Future[Any], Future[Any]]] = deque()

    def wrap(self, future: Future[_Result]) -> asyncio.Future[_Result]:
        """Return a future of the running loop with the same result."""
        loop = asyncio.get_running_loop()
        wrapped: asyncio.Future[_Result] = loop.create_future()

        def on_done(done: Future[_Result]) -> None:
            # Appended first: either it is the only one and wakes the loop, or a wake-up is still to come.
            self._done.append((wrapped, done))
            if len(self._done) == 1:
                loop.call_soon_threadsafe(self._resolve)

        future.add_done_callback(on_done)
        return wrapped

    def _resolve(self) -> None:
        while self._done:
            wrapped, done = self._done.popleft()
            if wrapped.done():
                continue
            error = done.exception()
            if error is None:
                wrapped.set_result(done.result())
            else:
                wrapped.set_exception(error)
