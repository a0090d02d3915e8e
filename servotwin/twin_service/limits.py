"""What one client may cost: the size and time of a body, and how many messages of a servo in how long."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from servotwin.messages import Refusal
from servotwin.twin_service.refused import Refused

Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
"""ASGI's: the next event of a request."""
REMEMBERED = 50_000
"""Servos."""
MEMORY = 256 * 1024 * 1024
"""Bytes of all bodies that are being read at once."""


class Disconnected(Exception):
    """The client has gone before its body was whole."""


class Bodies:
    """Reads bodies whole, within limits that hold before anything is parsed.

    Parameters
    ----------
    limit : int
        Bytes of one body, as sent.
    timeout : float
        s within which it has to be there.
    memory : int
        Bytes of all bodies that are being read; more are refused for the moment.
    """

    def __init__(self, limit: int, timeout: float, memory: int = MEMORY) -> None:
        self.limit, self.timeout, self._memory = limit, timeout, memory
        self.held = 0

    async def read(self, length: str | None, receive: Receive) -> bytes:
        """One request's body; `length` is its Content-Length, where it has one.

        Raises
        ------
        Refused
            TOO_LARGE, or UNAVAILABLE where it comes too slowly or too much is being read.
        Disconnected
        """
        if length is not None and (not length.isdecimal() or len(length) > 12 or int(length) > self.limit):
            raise self._too_large()
        try:
            async with asyncio.timeout(self.timeout):
                return await self._whole(receive)
        except TimeoutError:
            raise Refused(Refusal.UNAVAILABLE, f"the body did not come within {self.timeout:g} s", close=True) from None

    async def _whole(self, receive: Receive) -> bytes:
        event = await receive()
        if event["type"] == "http.request" and not event.get("more_body", False):
            return self._within(event.get("body", b""))
        parts, size = [], 0
        try:
            while True:
                if event["type"] != "http.request":
                    raise Disconnected
                part = event.get("body", b"")
                parts.append(part)
                size += len(part)
                self._hold(len(part), size)
                if not event.get("more_body", False):
                    return b"".join(parts)
                event = await receive()
        finally:
            self.held -= size

    def _hold(self, part: int, size: int) -> None:
        self.held += part
        if size > self.limit:
            raise self._too_large()
        if self.held > self._memory:
            raise Refused(Refusal.UNAVAILABLE, "too many bodies are being received now", close=True)

    def _within(self, body: bytes) -> bytes:
        if len(body) > self.limit:
            raise self._too_large()
        return body

    def _too_large(self) -> Refused:
        return Refused(Refusal.TOO_LARGE, f"the body is larger than {self.limit} bytes", close=True)


class Buckets:
    """For each servo a bucket of tokens: one is taken per message, `rate` are put in per s, `burst` at most lie there.

    Only so many are remembered; one that was forgotten is full.
    """

    def __init__(self, rate: float, burst: float, monotonic: Callable[[], float]) -> None:
        self._rate, self._burst, self._now = rate, max(1.0, burst), monotonic
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, servo: str) -> None:
        """One token of a servo.

        Raises
        ------
        Refused
            TOO_MANY: none is left.
        """
        now = self._now()
        level, at = self._levels.get(servo, (self._burst, now))
        level = min(self._burst, level + self._rate * (now - at))
        self._levels[servo] = (level if level < 1.0 else level - 1.0), now
        self._levels.move_to_end(servo)
        if len(self._levels) > REMEMBERED:
            self._levels.popitem(last=False)
        if level < 1.0:
            raise Refused(Refusal.TOO_MANY, f"more than {self._rate:g} messages per s of servo {servo!r}")
