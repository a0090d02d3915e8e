"""One raw connection to the twin, one request at a time: the load itself must cost little processor time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

Answered = Callable[[int, bytes], None]
"""Handler of a response: (status, body)."""
_HEAD_END = b"\r\n\r\n"
_LENGTH = b"content-length:"


class HttpConnection(asyncio.Protocol):
    """Send requests and hand each response to its handler.

    Parameters
    ----------
    broken : callable
        Called with the reason when the connection ends while a response is due.
    """

    def __init__(self, broken: Callable[[str], None]) -> None:
        self._broken = broken
        self._transport: asyncio.Transport | None = None
        self._answered: Answered | None = None
        self._buffer = bytearray()
        self._expected = -1

    @property
    def closed(self) -> bool:
        """True: the connection accepts no more requests."""
        return self._transport is None or self._transport.is_closing()

    def ask(self, head: bytes, body: bytes, answered: Answered) -> None:
        """Send a request; `head` lacks its length and the empty line."""
        assert self._transport is not None
        self._answered = answered
        self._transport.write(b"%bContent-Length: %d\r\n\r\n%b" % (head, len(body), body))

    def close(self) -> None:
        """Close the connection; no more requests."""
        self._answered = None
        if self._transport is not None:
            self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if self._answered is not None:
            self._broken(f"the twin closed a connection ({exc or 'at its end'})")

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        if self._expected < 0:
            end = self._buffer.find(_HEAD_END)
            if end < 0:
                return
            self._expected = end + len(_HEAD_END) + _length(bytes(self._buffer[:end]).lower())
        if len(self._buffer) >= self._expected:
            self._finish()

    def _finish(self) -> None:
        whole, answered = bytes(self._buffer[: self._expected]), self._answered
        del self._buffer[: self._expected]
        self._expected, self._answered = -1, None
        if answered is not None:
            answered(int(whole[9:12]), whole[whole.find(_HEAD_END) + len(_HEAD_END) :])


def _length(head: bytes) -> int:
    """Length of the body that a response announces."""
    begin = head.find(_LENGTH)
    if begin < 0:
        return 0
    end = head.find(b"\r\n", begin)
    return int(head[begin + len(_LENGTH) : end if end >= 0 else None])
