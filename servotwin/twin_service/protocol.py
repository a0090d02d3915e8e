"""HTTP/1.1 as uvicorn speaks it, with limits that hold before a request is one: of its head, and of the time for it."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

HEAD_BYTES, HEAD_S = 32 * 1024, 20.0
"""A request line with its headers: so long, and there within so many s of its first byte, or of the connection."""


class Protocol(HttpToolsProtocol):
    """One connection.

    A head that is endless, or never comes to its end, would otherwise keep memory or a descriptor for ever. So would a
    single header or trailer: the parser keeps it to itself, and tells nothing of it, until it is whole.
    """

    _head = _untold = 0
    _due: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._expect_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._head_is_whole()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        untold = self._untold = self._untold + len(data)
        super().data_received(data)
        if self._untold == untold > HEAD_BYTES:
            self.transport.abort()

    def on_body(self, body: bytes) -> None:
        self._untold = 0
        super().on_body(body)

    def on_message_begin(self) -> None:
        self._untold = 0
        super().on_message_begin()
        self._head = 0
        self._expect_head()

    def on_url(self, url: bytes) -> None:
        self._count(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        self._count(len(name) + len(value))
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._untold = 0
        self._head_is_whole()
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        self._untold = 0
        super().on_message_complete()

    def _count(self, size: int) -> None:
        self._untold = 0
        self._head += size
        if self._head > HEAD_BYTES:
            self.transport.abort()
            raise ValueError("the head of a request is too long")

    def _expect_head(self) -> None:
        if self._due is None:
            self._due = self.loop.call_later(HEAD_S, self.transport.abort)

    def _head_is_whole(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None
