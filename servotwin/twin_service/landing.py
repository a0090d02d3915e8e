"""What another thread promises, awaited on the event loop: woken once for all that one commit makes safe."""

from __future__ import annotations

import asyncio
from collections import deque
from concurrent.futures import Future
from typing import Any, TypeVar

_Result = TypeVar("_Result")


class Landing:
    """Futures of threads as futures of one event loop, that of its first use."""

    def __init__(self) -> None:
        self._landed: deque[tuple[asyncio.Future[Any], Future[Any]]] = deque()

    def __call__(self, there: Future[_Result]) -> asyncio.Future[_Result]:
        """The same here."""
        loop = asyncio.get_running_loop()
        here: asyncio.Future[_Result] = loop.create_future()

        def landed(done: Future[_Result]) -> None:
            # Appended first: either this finds itself alone and wakes the loop, or a wake-up is still to come.
            self._landed.append((here, done))
            if len(self._landed) == 1:
                loop.call_soon_threadsafe(self._settle)

        there.add_done_callback(landed)
        return here

    def _settle(self) -> None:
        while self._landed:
            here, done = self._landed.popleft()
            if here.done():
                continue
            error = done.exception()
            if error is None:
                here.set_result(done.result())
            else:
                here.set_exception(error)
