"""Long polls: an edge asks for its messages, and the response is sent as soon as there is one."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence

from servotwin.link.seal import TO_EDGE, key_of, seal
from servotwin.messages import Refusal
from servotwin.store.records import OutgoingMessage
from servotwin.twin_service.limits import RequestRejected

Read = Callable[[str, int], Awaitable[Sequence[OutgoingMessage]]]
"""(servo, serial) -> messages with higher serials, rising."""
MAX_WAIT_S = 30.0
"""s that an edge may wait."""
_NEVER = 2**63


class LongPolls:
    """Polls of edges that wait for messages.

    Parameters
    ----------
    read : callable
        Reads the store without blocking the event loop.
    limit : int
        Polls that may wait at once.
    shared : bool
        Other processes post messages too: the caller has to read from the store the newest serials of the servos in
        `waiting` and give them to `notify_serials`.

    Attributes
    ----------
    open : int
        Polls that are being served.
    """

    def __init__(self, read: Read, limit: int, shared: bool = False) -> None:
        self._read, self._limit, self._shared = read, limit, shared
        self._waiting: dict[str, dict[asyncio.Future[None], int]] = {}
        self._notifications: Counter[str] = Counter()
        self._empty_after: dict[str, int] = {}
        self._closed = False
        self.open = 0

    def notify(self, servo: str) -> None:
        """Wake the polls of a servo: it has a new message."""
        self._notifications[servo] += 1
        self._empty_after.pop(servo, None)
        for waiting in self._waiting.pop(servo, ()):
            if not waiting.done():
                waiting.set_result(None)

    @property
    def waiting(self) -> list[str]:
        """Servos whose edges wait for a message."""
        return list(self._waiting)

    def notify_serials(self, newest: Mapping[str, int]) -> None:
        """Wake the polls that wait for serials up to the newest of their servo, whichever process posted it."""
        for servo, serial in newest.items():
            if any(after < serial for after in self._waiting.get(servo, {}).values()):
                self.notify(servo)

    def close(self) -> None:
        """End every poll now."""
        self._closed = True
        for servo in list(self._waiting):
            self.notify(servo)

    async def messages(self, servo: str, after: int, wait: float) -> Sequence[OutgoingMessage]:
        """Messages with serials above `after`, as soon as there are some; none after `wait` s.

        Raises
        ------
        RequestRejected
            TOO_MANY polls wait.
        """
        if self.open >= self._limit:
            raise RequestRejected(Refusal.TOO_MANY, f"{self._limit} polls wait already")
        self.open += 1
        try:
            return await self._poll(servo, after, wait)
        finally:
            self.open -= 1

    async def _poll(self, servo: str, after: int, wait: float) -> Sequence[OutgoingMessage]:
        loop = asyncio.get_running_loop()
        until = loop.time() + wait
        while True:
            notifications = self._notifications[servo]
            messages = await self._read_newer(servo, after)
            left = until - loop.time()
            if messages or left <= 0.0 or self._closed:
                return messages
            # A notification that came while the store was read must not be slept through.
            if notifications == self._notifications[servo]:
                await self._sleep(servo, after, left)

    async def _read_newer(self, servo: str, after: int) -> Sequence[OutgoingMessage]:
        """Read the store, unless it is known to hold nothing newer."""
        notifications = self._notifications[servo]
        if not self._shared and after >= self._empty_after.get(servo, _NEVER):
            return ()
        messages = await self._read(servo, after)
        if not messages and notifications == self._notifications[servo]:
            self._empty_after[servo] = after
        return messages

    async def _sleep(self, servo: str, after: int, seconds: float) -> None:
        """Sleep until a notification, at most `seconds`."""
        waiting: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(servo, {})[waiting] = after
        try:
            async with asyncio.timeout(seconds):
                await waiting
        except TimeoutError:
            pass
        finally:
            others = self._waiting.get(servo)
            if others is not None:
                others.pop(waiting, None)
                if not others:
                    del self._waiting[servo]


def seal_messages(verifier: bytes, servo: str, messages: Sequence[OutgoingMessage]) -> list[bytes]:
    """Seal messages for an edge."""
    key = key_of(verifier)
    return [seal(key, TO_EDGE, servo, message.serial, message.body) for message in messages]
