"""Messages that wait for their edge: edges ask, and wait for an answer that comes as soon as there is one."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence

from servotwin.link.seal import TO_EDGE, key_of, seal
from servotwin.messages import Refusal
from servotwin.store.records import OutgoingMessage
from servotwin.twin_service.refused import Refused

Read = Callable[[str, int], Awaitable[Sequence[OutgoingMessage]]]
"""(servo, serial) -> messages of higher serials, rising."""
NEVER = 2**63
LONGEST = 30.0
"""s that an edge may wait."""


class Outgoing:
    """Answers polls.

    Parameters
    ----------
    read : callable
        Asks the store, without blocking the event loop.
    most : int
        Polls that may wait at once.
    shared : bool
        Other processes post too: somebody has to ask the store now and then what is `posted`, for those `waiting`.
    """

    def __init__(self, read: Read, most: int, shared: bool = False) -> None:
        self._read, self._most, self._shared = read, most, shared
        self._waiting: dict[str, dict[asyncio.Future[None], int]] = {}
        self._posts: Counter[str] = Counter()
        self._silent: dict[str, int] = {}
        self._closed = False
        self.polls = 0

    def post(self, servo: str) -> None:
        """Something new lies there for a servo."""
        self._posts[servo] += 1
        self._silent.pop(servo, None)
        for waiting in self._waiting.pop(servo, ()):
            if not waiting.done():
                waiting.set_result(None)

    @property
    def waiting(self) -> list[str]:
        """Servos whose edges wait for a message."""
        return list(self._waiting)

    def posted(self, newest: Mapping[str, int]) -> None:
        """The newest serial of some servos, whoever posted it."""
        for servo, serial in newest.items():
            if any(after < serial for after in self._waiting.get(servo, {}).values()):
                self.post(servo)

    def close(self) -> None:
        """Let every poll end now."""
        self._closed = True
        for servo in list(self._waiting):
            self.post(servo)

    async def after(self, servo: str, serial: int, wait: float) -> Sequence[OutgoingMessage]:
        """Messages of higher serials, as soon as there are some; none after `wait` s.

        Raises
        ------
        Refused
            TOO_MANY polls wait.
        """
        if self.polls >= self._most:
            raise Refused(Refusal.TOO_MANY, f"{self._most} polls wait already")
        self.polls += 1
        try:
            return await self._poll(servo, serial, wait)
        finally:
            self.polls -= 1

    async def _poll(self, servo: str, serial: int, wait: float) -> Sequence[OutgoingMessage]:
        loop = asyncio.get_running_loop()
        until = loop.time() + wait
        while True:
            posts = self._posts[servo]
            found = await self._look(servo, serial)
            left = until - loop.time()
            if found or left <= 0.0 or self._closed:
                return found
            if posts == self._posts[servo]:
                await self._sleep(servo, serial, left)

    async def _look(self, servo: str, serial: int) -> Sequence[OutgoingMessage]:
        """Ask the store, unless it is known to hold nothing newer."""
        posts = self._posts[servo]
        if not self._shared and serial >= self._silent.get(servo, NEVER):
            return ()
        found = await self._read(servo, serial)
        if not found and posts == self._posts[servo]:
            self._silent[servo] = serial
        return found

    async def _sleep(self, servo: str, serial: int, seconds: float) -> None:
        """Until something is posted, `seconds` at most."""
        waiting: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(servo, {})[waiting] = serial
        try:
            async with asyncio.timeout(seconds):
                await waiting
        except TimeoutError:
            pass
        finally:
            self._forget(servo, waiting)

    def _forget(self, servo: str, waiting: asyncio.Future[None]) -> None:
        others = self._waiting.get(servo)
        if others is not None:
            others.pop(waiting, None)
            if not others:
                del self._waiting[servo]


def sealed(verifier: bytes, servo: str, posted: Sequence[OutgoingMessage]) -> list[bytes]:
    """The messages as an edge takes them."""
    key = key_of(verifier)
    return [seal(key, TO_EDGE, servo, message.serial, message.body) for message in posted]
