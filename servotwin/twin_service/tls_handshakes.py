"""TLS handshakes within limits: one that never finishes is cut, and only so many are in progress at once.

asyncio's own server waits for a minute and for any number, before the service learns of a connection. Here a connection
counts from the moment it is accepted.
"""

from __future__ import annotations

import asyncio
import ssl
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any, cast

_HANDSHAKE_S = 10.0
"""s for a handshake: a few round trips, and its turn among those of all edges after an outage."""
_BUFFERED = 64 * 1024
"""Bytes that came with the end of a handshake, from which nothing more is read until the connection is handed on."""


class TlsHandshakes:
    """Handshakes in progress; a factory of protocols that do one, and then hand the connection on.

    Parameters
    ----------
    context : SSLContext
    make : callable
        Makes the protocol of a connection.
    most : int
        Handshakes in progress at once, of which one address may have half.
    """

    def __init__(self, context: ssl.SSLContext, make: Callable[..., asyncio.Protocol], most: int) -> None:
        self.context, self.make, self._most = context, make, most
        self._of = Counter[str]()
        self._open: set[asyncio.Transport] = set()

    def __call__(self, **options: Any) -> asyncio.Protocol:
        """Make the protocol of a new connection."""
        return _Handshake(self, options)

    @property
    def open(self) -> int:
        """Handshakes in progress."""
        return len(self._open)

    def enter(self, transport: asyncio.Transport) -> bool:
        """Count a new connection; False: there are too many, in all or from its address."""
        address = address_of(transport)
        if len(self._open) >= self._most or self._of[address] >= max(1, self._most // 2):
            return False
        self._of[address] += 1
        self._open.add(transport)
        return True

    def leave(self, transport: asyncio.Transport) -> None:
        """Count a connection no longer."""
        if transport in self._open:
            address = address_of(transport)
            self._open.discard(transport)
            self._of[address] -= 1
            if not self._of[address]:
                del self._of[address]

    def abort(self) -> None:
        """End all that are in progress."""
        for transport in list(self._open):
            transport.abort()


class _Handshake(asyncio.Protocol):
    """A connection until its handshake is done."""

    def __init__(self, handshakes: TlsHandshakes, options: dict[str, Any]) -> None:
        self._handshakes, self._options = handshakes, options
        self._early, self._ended = bytearray(), False
        self._task: asyncio.Task[None] | None = None
        self._accepted: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        accepted = self._accepted = cast(asyncio.Transport, transport)
        if not self._handshakes.enter(accepted):
            accepted.abort()
            return
        # The loop has weak references to tasks only.
        self._task = asyncio.get_running_loop().create_task(self._shake(accepted))

    def data_received(self, data: bytes) -> None:
        self._early += data
        # An edge sends a window of any size right after its handshake, and the loop may be busy meanwhile.
        if len(self._early) > _BUFFERED and self._accepted is not None:
            self._accepted.pause_reading()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        self._ended = True

    async def _shake(self, accepted: asyncio.Transport) -> None:
        try:
            with suppress(OSError, ssl.SSLError, TimeoutError):
                loop = asyncio.get_running_loop()
                encrypted = await loop.start_tls(
                    accepted, self, self._handshakes.context, server_side=True, ssl_handshake_timeout=_HANDSHAKE_S
                )
                if encrypted is not None:
                    self._hand_on(encrypted)
        finally:
            self._handshakes.leave(accepted)

    def _hand_on(self, encrypted: asyncio.Transport) -> None:
        """Let the connection's own protocol take over, with what came before it was there."""
        if self._ended:
            encrypted.abort()
            return
        protocol = self._handshakes.make(**self._options)
        encrypted.set_protocol(protocol)
        protocol.connection_made(encrypted)
        if self._early:
            protocol.data_received(bytes(self._early))
        if self._accepted is not None:
            self._accepted.resume_reading()


def address_of(transport: asyncio.BaseTransport) -> str:
    """Address of the other end; empty where it is not known."""
    peer = transport.get_extra_info("peername")
    return str(peer[0]) if isinstance(peer, tuple) and peer else ""
