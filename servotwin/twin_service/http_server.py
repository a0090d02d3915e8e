"""HTTP server: uvicorn with limits on head and body of a request, the listening socket and TLS."""

from __future__ import annotations

import asyncio
import signal
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, cast

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from servotwin.errors import InvalidInput
from servotwin.messages import Refusal
from servotwin.runtime.service_manager import ServiceManager
from servotwin.twin_service.config import ServiceConfig
from servotwin.twin_service.http_app import HttpApp
from servotwin.twin_service.http_messages import ABORT
from servotwin.twin_service.limits import Disconnected, Receive, RequestRejected
from servotwin.twin_service.listening import BACKLOG, most_descriptors
from servotwin.twin_service.tls_handshakes import TlsHandshakes, address_of
from servotwin.twin_service.unauthenticated import UnauthenticatedConnection, UnauthenticatedLimit

_HEAD_BYTES, _HEAD_S = 32 * 1024, 20.0
"""Largest request line with headers, and s from its first byte (or the connection) to its last."""
_DRAIN_BYTES, _DRAIN_S = 256 * 1024, 2.0
"""Rest of a body that is still received, and discarded, after its request was answered; then the connection ends. An
edge whose token is no longer valid can so read its answer, and a client without one holds nothing."""
_BODY_MEMORY = 256 * 1024 * 1024
"""Bytes of all bodies that are being received at once."""
_GRACE_S = 20
"""s that running requests may take when the service is told to stop."""
_CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""For TLS 1.2; every cipher of 1.3 is allowed. The defaults of older uvicorns include ciphers without encryption."""
_IDLE_S = 75
"""s after which an idle connection is closed."""


class _LimitedHttpProtocol(HttpToolsProtocol):
    """HTTP/1.1 connection with limits on the size and time of a request's head.

    A head that is endless, or never complete, would otherwise hold memory or a descriptor for ever. So would a single
    header or trailer, which the parser reports only once it is complete.
    """

    _head = _unreported = _drained = 0
    _timer: asyncio.TimerHandle | None = None
    _drain_timer: asyncio.TimerHandle | None = None
    _connection: UnauthenticatedConnection | None = None

    def __init__(self, *, unauthenticated: UnauthenticatedLimit | None, **options: Any) -> None:
        super().__init__(**options)
        self._unauthenticated = unauthenticated

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._start_timer()
        if self._unauthenticated is not None:
            self._connection = self._unauthenticated.enter(address_of(transport), transport.abort)
            if self._connection is None:
                transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._connection is not None:
            self._connection.end()
        self._stop_timer()
        self._stop_drain()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        unreported = self._unreported = self._unreported + len(data)
        super().data_received(data)
        # Unchanged: the parser reported nothing of this data.
        if self._unreported == unreported > _HEAD_BYTES:
            self.transport.abort()

    def on_body(self, body: bytes) -> None:
        self._unreported = 0
        super().on_body(body)
        if self.cycle.response_complete:
            self._drained += len(body)
            if self._drained > _DRAIN_BYTES:
                self.transport.abort()

    def on_message_begin(self) -> None:
        self._unreported = 0
        super().on_message_begin()
        cast(dict[str, Any], self.scope)["extensions"] = {ABORT: self.transport.abort}
        self._head = 0
        self._start_timer()

    def on_url(self, url: bytes) -> None:
        self._count(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        self._count(len(name) + len(value))
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._unreported = 0
        self._stop_timer()
        if self._connection is not None:
            headers = dict(self.headers)
            self._connection.show(headers.get(b"authorization"), headers.get(b"cookie"))
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        self._unreported = 0
        self._stop_drain()
        super().on_message_complete()

    def on_response_complete(self) -> None:
        # Answered before its body was complete: a rejection.
        if self.cycle.more_body and not self.transport.is_closing():
            self._drained = 0
            self._drain_timer = self.loop.call_later(_DRAIN_S, self.transport.abort)
        super().on_response_complete()

    def _stop_drain(self) -> None:
        if self._drain_timer is not None:
            self._drain_timer.cancel()
            self._drain_timer = None

    def _count(self, size: int) -> None:
        self._unreported = 0
        self._head += size
        if self._head > _HEAD_BYTES:
            self.transport.abort()
            raise ValueError("the head of a request is too long")

    def _start_timer(self) -> None:
        if self._timer is None:
            self._timer = self.loop.call_later(_HEAD_S, self.transport.abort)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class BodyReader:
    """Receives bodies within limits that hold before anything is parsed.

    Parameters
    ----------
    limit : int
        Bytes of one body, as sent.
    timeout : float
        s within which it has to arrive.
    memory : int
        Bytes of all bodies that are being received; beyond that bodies are rejected for the moment.

    Attributes
    ----------
    buffered : int
        Bytes of incomplete bodies in memory.
    """

    def __init__(self, limit: int, timeout: float, memory: int = _BODY_MEMORY) -> None:
        self.limit, self.timeout, self._memory = limit, timeout, memory
        self.buffered = 0

    async def read(self, length: str | None, receive: Receive) -> bytes:
        """Receive the body of one request; `length` is its Content-Length, where it has one.

        Raises
        ------
        RequestRejected
            TOO_LARGE, or UNAVAILABLE where it arrives too slowly or too many bodies are being received.
        Disconnected
        """
        if length is not None and (not length.isdecimal() or len(length) > 12 or int(length) > self.limit):
            raise self._too_large()
        try:
            async with asyncio.timeout(self.timeout):
                return await self._receive_all(receive)
        except TimeoutError:
            detail = f"the body did not come within {self.timeout:g} s"
            raise RequestRejected(Refusal.UNAVAILABLE, detail, close=True) from None

    async def _receive_all(self, receive: Receive) -> bytes:
        event = await receive()
        # Most bodies come in one event: nothing is accumulated then.
        if event["type"] == "http.request" and not event.get("more_body", False):
            body: bytes = event.get("body", b"")
            if len(body) > self.limit:
                raise self._too_large()
            return body
        parts, size = [], 0
        try:
            while True:
                if event["type"] != "http.request":
                    raise Disconnected
                part = event.get("body", b"")
                parts.append(part)
                size += len(part)
                self._count(len(part), size)
                if not event.get("more_body", False):
                    return b"".join(parts)
                event = await receive()
        finally:
            self.buffered -= size

    def _count(self, part: int, size: int) -> None:
        self.buffered += part
        if size > self.limit:
            raise self._too_large()
        if self.buffered > self._memory:
            raise RequestRejected(Refusal.UNAVAILABLE, "too many bodies are being received now", close=True)

    def _too_large(self) -> RequestRejected:
        return RequestRejected(Refusal.TOO_LARGE, f"the body is larger than {self.limit} bytes", close=True)


class HttpServer(uvicorn.Server):
    """uvicorn that prints its address once it accepts requests, and ends long polls when it has to stop.

    Parameters
    ----------
    config : ServiceConfig
    app : HttpApp
    close_polls : callable
        Ends all long polls.
    unauthenticated : UnauthenticatedLimit or None
        Limit of the connections that have shown no token.
    works : callable
        Test whether the service still does its work; where it does not, the service manager's watchdog restarts it.
    """

    def __init__(
        self,
        config: ServiceConfig,
        app: HttpApp,
        close_polls: Callable[[], None],
        unauthenticated: UnauthenticatedLimit | None,
        works: Callable[[], bool],
    ) -> None:
        super().__init__(_server_config(config, app, unauthenticated))
        self._handshakes: TlsHandshakes | None = None
        self._most_handshakes = min(config.unauthenticated_connections, max(1, most_descriptors() // 3))
        self._close_polls, self._works, self._manager = close_polls, works, ServiceManager()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Stop at both signals; that is a regular end, so that they are not raised again afterwards."""
        former = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)

    @property
    def handshakes(self) -> int:
        """TLS handshakes in progress."""
        return 0 if self._handshakes is None else self._handshakes.open

    def _limit_handshakes(self) -> None:
        """Do TLS here: uvicorn leaves it to asyncio, without a limit that suits clients without a token."""
        context, make = self.config.ssl, self.config.http_protocol_class
        if context is not None:
            self._handshakes = TlsHandshakes(context, make, self._most_handshakes)
            self.config.ssl, self.config.http_protocol_class = None, self._handshakes  # type: ignore[assignment]

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        self._limit_handshakes()
        await super().startup(sockets)
        for each in sockets or ():
            with suppress(OSError):  # a full disk under its output is no reason to serve nobody
                print(f"servotwin twin: listening on {_url(each, self.config.is_ssl)}", flush=True)
        if self.started:
            self._manager.ready()

    async def on_tick(self, counter: int) -> bool:
        if self._works():
            self._manager.alive(time.monotonic())
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._manager.stopping()
        self._close_polls()
        if self._handshakes is not None:
            self._handshakes.abort()
        await super().shutdown(sockets)


def _server_config(config: ServiceConfig, app: HttpApp, unauthenticated: UnauthenticatedLimit | None) -> uvicorn.Config:
    """Configure uvicorn."""
    return uvicorn.Config(
        app,
        http=partial(_LimitedHttpProtocol, unauthenticated=unauthenticated),  # type: ignore[arg-type]
        ws="none",
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        backlog=BACKLOG,
        timeout_keep_alive=_IDLE_S,
        timeout_graceful_shutdown=_GRACE_S,
        ssl_certfile=config.tls_certificate,
        ssl_keyfile=config.tls_key,
        ssl_ciphers=_CIPHERS,
    )


def check_tls(config: ServiceConfig) -> None:
    """Check that certificate and key can be read and belong together, before anything listens.

    Raises
    ------
    InvalidInput
    """
    certificate, key = config.tls_certificate, config.tls_key
    if certificate is None or key is None:
        return
    try:
        # The password is given, or OpenSSL would ask for one on a terminal.
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except (OSError, ValueError) as error:
        raise InvalidInput(
            f"tls_certificate {certificate}, tls_key {key}: are no certificate with its own key, in PEM and without a "
            f"password ({getattr(error, 'reason', None) or error})"
        ) from None


def _url(listener: socket.socket, tls: bool) -> str:
    host, port = listener.getsockname()[:2]
    return f"{'https' if tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}"
