"""One raw connection to the twin, one request at a time: the load itself must cost little processor time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

Answered = Callable[[int, bytes], None]
"""Handler of a response: (status, body)."""
_HEAD_END = b"\r\n\r\n"
_LENGTH, _PAUSE = b"content-length:", b"servotwin-older-pause:"


class HttpConnection(asyncio.Protocol):
    """Send requests and hand each response to its handler.

    Parameters
    ----------
    broken : callable
        Called with the reason when the connection ends while a response is due.

    Attributes
    ----------
    older_pause : float
        Pause before older windows in the last response, s.
    """

    def __init__(self, broken: Callable[[str], None]) -> None:
        self._broken = broken
        self._transport: asyncio.Transport | None = None
        self._answered: Answered | None = None
        self._buffer = bytearray()
        self._expected = -1
        self.older_pause = 0.0

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
            head = bytes(self._buffer[:end]).lower()
            self._expected = end + len(_HEAD_END) + int(_header(head, _LENGTH))
            self.older_pause = float(_header(head, _PAUSE))
        if len(self._buffer) >= self._expected:
            self._finish()

    def _finish(self) -> None:
        whole, answered = bytes(self._buffer[: self._expected]), self._answered
        del self._buffer[: self._expected]
        self._expected, self._answered = -1, None
        if answered is not None:
            answered(int(whole[9:12]), whole[whole.find(_HEAD_END) + len(_HEAD_END) :])


def _header(head: bytes, name: bytes) -> bytes:
    """Value of a response's header; 0 where it has none."""
    begin = head.find(name)
    if begin < 0:
        return b"0"
    end = head.find(b"\r\n", begin)
    return head[begin + len(name) : end if end >= 0 else None]
