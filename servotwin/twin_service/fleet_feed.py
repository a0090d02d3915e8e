"""Changes of the fleet as server-sent events: read once a second for all watchers, resumed where a watcher left off."""

from __future__ import annotations

import asyncio
import logging
import re
from collections import deque
from collections.abc import AsyncGenerator, Callable, Collection
from contextlib import suppress

import msgspec

from servotwin.messages import Refusal
from servotwin.store.engine import StoreUnavailable
from servotwin.store.overview import StorePosition
from servotwin.twin_service.fleet_process import ChangeReader, ChangesQuestion
from servotwin.twin_service.fleet_reader import EdgePresence
from servotwin.twin_service.limits import RequestRejected

log = logging.getLogger(__name__)

_TICK_S, _QUIET_S = 1.0, 15.0
"""s between two looks at the store; s without an event after which a comment shows that the connection lives."""
_ROWS, _MOST = 1000, 8000
"""Rows of one event, and of one look; where more changed, watchers are told to read the fleet anew."""
_WAITING = 16
"""Events that wait for a slow watcher; then its stream ends, and it resumes."""
_PAUSE_S, _SPREAD_S = 0.002, 0.5
"""s between two watchers that get an event; s within which all of them have it."""
_IDLE_S = 60.0
"""s without a watcher after which the process that reads for them ends."""
_TICKS_BACK = 3
"""On a shared database a row with a lower id may be committed later: its servo is sent again for so many ticks."""
_POSITION = re.compile(r"(\d{1,18})-(\d{1,18})")

_NOT_READ = "The twin cannot read its store now."
_DAMAGED = "The twin's store is damaged: no window is stored until it is sound, and edges keep theirs."


class FleetFeed:
    """Sends changes to watchers.

    Parameters
    ----------
    changes : ChangeReader
    presence : EdgePresence
    limit : int
        Watchers at once.
    shared : bool
        Other processes write to the store.
    damage : callable
        Fault of the store; empty: there is none. Where it has one nothing is written to it, and what is read is old.

    Attributes
    ----------
    closing : asyncio.Event
        Set once all streams are to end.
    watchers : int
    """

    def __init__(
        self, changes: ChangeReader, presence: EdgePresence, limit: int, shared: bool, damage: Callable[[], str]
    ) -> None:
        self._changes, self._presence, self._damage = changes, presence, damage
        self._limit, self.closing, self._open = limit, asyncio.Event(), 0
        self._queues: set[asyncio.Queue[bytes | None]] = set()
        self._positions: deque[StorePosition] = deque(maxlen=_TICKS_BACK if shared else 1)
        self._connected: frozenset[str] = frozenset()
        self._unreadable = False

    @property
    def watchers(self) -> int:
        """Number of streams, those included whose events are no longer taken."""
        return self._open

    def close(self) -> None:
        """End all streams; new ones end at once."""
        self.closing.set()
        for queue in self._queues:
            queue.put_nowait(None)

    def admit(self) -> None:
        """Check that there is room for a watcher; raises RequestRejected."""
        if self._open >= self._limit:
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
        self._open += 1
        if self.closing.is_set():
            queue.put_nowait(None)
        try:
            yield b"retry: 2000\n\n"
            # A link may have changed between the reader's look at the fleet and this one.
            yield _event("links", None, msgspec.json.encode(self._presence.links()))
            if after is not None:
                await self._begin()  # before the changes are read: those that come meanwhile are the feed's to send
                for event in await self._since(after):
                    yield event
            while (waited := await _next(queue)) is not None:
                allowed()
                yield waited
        except RequestRejected:
            yield _event("ended", None, b'"the session has ended"')
        finally:
            self._queues.discard(queue)
            self._open -= 1

    async def run(self) -> None:
        """Look at the store once a second while there are watchers."""
        idle = 0.0
        while True:
            if self._queues:
                idle = 0.0
                self._changes.start()
                for event in await self._look():
                    await self._send(event)
            else:
                self._positions.clear()
                self._presence.refresh()  # for whoever reads the fleet without watching it
                idle += _TICK_S
                if idle > _IDLE_S:
                    await self._changes.stop()
            await asyncio.sleep(_TICK_S)

    async def _look(self) -> list[bytes]:
        """Events of one look; where it fails for whatever reason, watchers are told, and the next look repeats it."""
        try:
            return await self._changed()
        except Exception as error:
            first, self._unreadable = not self._unreadable, True
            if not first:
                return []
            if isinstance(error, StoreUnavailable):
                return [self._trouble()]
            log.exception("the feed of the fleet failed")
            return [_event("trouble", None, b'"The twin cannot follow the fleet now."')]

    async def _begin(self) -> None:
        """Begin at the present position, unless the feed has one."""
        if not self._positions:
            with suppress(StoreUnavailable):
                present = await self._changes.position()
                if not self._positions:
                    self._positions.append(present)

    async def _changed(self) -> list[bytes]:
        """Events with the rows that changed since the last look."""
        connected, since = self._presence.refresh(), self._positions[0] if self._positions else None
        if since is None:
            since = await self._changes.position()
        events, position = await self._events(since, self._connected ^ connected, self._unreadable)
        # Only now: what fails is repeated from the same place.
        if not self._positions:
            self._positions.append(since)
        self._positions.append(position)
        self._connected, self._unreadable = connected, False
        return events

    async def _since(self, after: StorePosition) -> list[bytes]:
        """Events with the rows that changed after a position, at least one."""
        try:
            return (await self._events(after, (), True))[0]
        except StoreUnavailable:
            return [self._trouble()]

    def _trouble(self) -> bytes:
        """Event that says why the fleet cannot be followed."""
        return _event("trouble", None, f'"{_DAMAGED if self._damage() else _NOT_READ}"'.encode())

    async def _events(
        self, since: StorePosition, names: Collection[str], empty: bool
    ) -> tuple[list[bytes], StorePosition]:
        """Events, and the position after them; only the last one has it, from which a broken stream resumes.

        `empty`: send an event of no rows where nothing changed. Raises StoreUnavailable also where only reading works.
        """
        if fault := self._damage():
            raise StoreUnavailable(fault)
        connected, sole = self._presence.connected()
        found = await self._changes.read(ChangesQuestion(since, tuple(names), connected, sole, _ROWS, _MOST))
        if found.many:
            return [_event("reload", found.position, b'""')], found.position
        parts = found.parts or ((b"[]",) if empty else ())
        places = [None] * (len(parts) - 1) + [found.position]
        return [_event("rows", place, part) for place, part in zip(places, parts, strict=False)], found.position

    async def _send(self, event: bytes) -> None:
        """Give an event to one watcher after the other: acknowledgements have the loop to themselves in between."""
        queues = tuple(self._queues)
        pause = min(_PAUSE_S, _SPREAD_S / max(1, len(queues)))
        for queue in queues:
            if queue.qsize() < _WAITING:
                queue.put_nowait(event)
            else:
                # It gets what waits, but not this: so it resumes from the last event that it got.
                queue.put_nowait(None)
                self._queues.discard(queue)
            await asyncio.sleep(pause)


def position_of(text: str | None) -> StorePosition | None:
    """Position in the id of an event; None: there is none, or it is none of ours."""
    match = _POSITION.fullmatch(text or "")
    return None if match is None else StorePosition(int(match[1]), int(match[2]))


async def _next(queue: asyncio.Queue[bytes | None]) -> bytes | None:
    try:
        async with asyncio.timeout(_QUIET_S):
            return await queue.get()
    except TimeoutError:
        return b"event: alive\ndata: {}\n\n"


def _event(kind: str, position: StorePosition | None, data: bytes) -> bytes:
    """Compose an event; its data is JSON on one line."""
    name = b"" if position is None else f"id: {position.text}\n".encode()
    return name + f"event: {kind}\n".encode() + b"data: " + data + b"\n\n"
