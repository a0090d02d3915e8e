"""Changes of the fleet as server-sent events: read once a second for all watchers, resumed where a watcher left off."""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import AsyncGenerator, Callable, Collection
from functools import partial

import msgspec

from servotwin.messages import Refusal
from servotwin.store.engine import StoreUnavailable
from servotwin.store.overview import StorePosition
from servotwin.twin_service.fleet_reader import EdgePresence, FleetReader
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.store_executor import StoreExecutor

_TICK_S, _QUIET_S = 1.0, 15.0
"""s between two looks at the store; s without an event after which a comment shows that the connection lives."""
_MOST = 1000
"""Rows of one event; where more changed, watchers are told to read the fleet anew."""
_WAITING = 16
"""Events that wait for a slow watcher; then its stream ends, and it resumes."""
_TICKS_BACK = 3
"""On a shared database a row with a lower id may be committed later: its servo is sent again for so many ticks."""
_POSITION = re.compile(r"(\d{1,18})-(\d{1,18})")


class FleetFeed:
    """Sends changes to watchers.

    Parameters
    ----------
    reader : FleetReader
    executor : StoreExecutor
    presence : EdgePresence
    limit : int
        Watchers at once.
    shared : bool
        Other processes write to the store.

    Attributes
    ----------
    watchers : int
    """

    def __init__(
        self, reader: FleetReader, executor: StoreExecutor, presence: EdgePresence, limit: int, shared: bool
    ) -> None:
        self._reader, self._executor, self._presence = reader, executor, presence
        self._limit, self._closed = limit, False
        self._queues: set[asyncio.Queue[bytes | None]] = set()
        self._joined = asyncio.Event()
        self._positions: deque[StorePosition] = deque(maxlen=_TICKS_BACK if shared else 1)
        self._connected: frozenset[str] = frozenset()
        self._unreadable = False

    @property
    def watchers(self) -> int:
        """Number of streams."""
        return len(self._queues)

    def close(self) -> None:
        """End all streams; new ones end at once."""
        self._closed = True
        for queue in self._queues:
            queue.put_nowait(None)

    def admit(self) -> None:
        """Check that there is room for a watcher; raises RequestRejected."""
        if len(self._queues) >= self._limit:
            raise RequestRejected(Refusal.TOO_MANY, f"{self._limit} pages watch the fleet already")

    async def watch(self, after: StorePosition | None, allowed: Callable[[], object]) -> AsyncGenerator[bytes, None]:
        """Events from a position on, or from now.

        Parameters
        ----------
        after : StorePosition or None
        allowed : callable
            Called before each event: where it raises RequestRejected, the stream ends.
        """
        queue: asyncio.Queue[bytes | None] = asyncio.Queue()
        self._queues.add(queue)
        self._joined.set()
        if self._closed:
            queue.put_nowait(None)
        try:
            yield b"retry: 2000\n\n"
            if after is not None:
                yield await self._since(after)
            while (event := await _next(queue)) is not None:
                allowed()
                yield event
        except RequestRejected:
            yield _event("ended", None, "the session has ended")
        finally:
            self._queues.discard(queue)

    async def run(self) -> None:
        """Look at the store once a second while there are watchers."""
        while True:
            if not self._queues:
                self._positions.clear()
                self._joined.clear()
                await self._joined.wait()
            try:
                event = await self._changes()
            except StoreUnavailable:
                event = b"" if self._unreadable else _event("trouble", None, "the twin cannot read its store now")
                self._unreadable = True
            if event:
                self._send(event)
            await asyncio.sleep(_TICK_S)

    async def _changes(self) -> bytes:
        """Event with the rows that changed since the last look; empty: none did."""
        before, self._connected = self._connected, self._presence.refresh()
        if not self._positions:
            self._positions.append(await self._executor.run(self._reader.position))
            return b""
        names, position = await self._executor.run(partial(self._reader.changed, self._positions[0], _MOST + 1))
        self._positions.append(position)
        recovered, self._unreadable = self._unreadable, False
        if not names and before == self._connected and not recovered:
            return b""
        return await self._rows({*names, *(before ^ self._connected)}, position)

    async def _since(self, after: StorePosition) -> bytes:
        """Event with the rows that changed after a position."""
        try:
            names, position = await self._executor.run(partial(self._reader.changed, after, _MOST + 1))
            return await self._rows(names, position)
        except StoreUnavailable:
            return _event("trouble", None, "the twin cannot read its store now")

    async def _rows(self, names: Collection[str], position: StorePosition) -> bytes:
        if len(names) > _MOST:
            return _event("reload", position, "")
        return _event("rows", position, await self._executor.run(partial(self._reader.rows, names)))

    def _send(self, event: bytes) -> None:
        for queue in tuple(self._queues):
            if queue.qsize() < _WAITING:
                queue.put_nowait(event)
            else:
                # It gets what waits, but not this: so it resumes from the last event that it got.
                queue.put_nowait(None)
                self._queues.discard(queue)


def position_of(text: str | None) -> StorePosition | None:
    """Position in the id of an event; None: there is none, or it is none of ours."""
    match = _POSITION.fullmatch(text or "")
    return None if match is None else StorePosition(int(match[1]), int(match[2]))


async def _next(queue: asyncio.Queue[bytes | None]) -> bytes | None:
    try:
        async with asyncio.timeout(_QUIET_S):
            return await queue.get()
    except TimeoutError:
        return b": still there\n\n"


def _event(kind: str, position: StorePosition | None, data: object) -> bytes:
    """Encode an event; its data is JSON on one line."""
    name = b"" if position is None else f"id: {position.text}\n".encode()
    return name + f"event: {kind}\n".encode() + b"data: " + msgspec.json.encode(data) + b"\n\n"
