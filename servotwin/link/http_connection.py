"""One HTTP connection to the twin that stays open, and that another thread can end at any time."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException, HTTPMessage, HTTPResponse, HTTPSConnection
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from servotwin.link.connection_errors import cause_of
from servotwin.link.transport import Unreachable
from servotwin.link.url import is_encrypted, tls_context

if TYPE_CHECKING:
    import ssl

_PIECE = 65536


class HttpAnswer(NamedTuple):
    """Status, body and headers of a response."""

    status: int
    body: bytes
    headers: HTTPMessage


class _PlainConnection(HTTPConnection):
    """A connection whose socket is known, and can be shut down, while it is still being connected."""

    ended, interrupted = False, False

    def connect(self) -> None:
        """Connect to the first address that accepts; raises OSError where none does."""
        *others, last = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)
        for family, kind, protocol, _, address in others:
            with suppress(OSError):
                self._connect(family, kind, protocol, address)
                return
            self._check_not_ended()
        family, kind, protocol, _, address = last
        self._connect(family, kind, protocol, address)

    def end(self) -> None:
        """Wake the thread that connects, or waits for a response: its call fails."""
        self.ended = True
        self.shut_down()

    def shut_down(self) -> None:
        """Wake the thread that waits for a response: its call fails."""
        with suppress(OSError):
            if self.sock is not None:
                self.sock.shutdown(socket.SHUT_RDWR)

    def _connect(self, family: int, kind: int, protocol: int, address: tuple[object, ...]) -> None:
        self.sock = connecting = socket.socket(family, kind, protocol)
        try:
            connecting.settimeout(self.timeout)
            self._check_not_ended()
            connecting.connect(address)
            connecting.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except (OSError, Unreachable):
            connecting.close()
            self.sock = None
            raise

    def _check_not_ended(self) -> None:
        if self.ended:
            raise Unreachable("the link is closed")


class _TlsConnection(_PlainConnection):
    """The same with TLS, also while its handshake is under way."""

    default_port = HTTPSConnection.default_port

    def __init__(self, host: str, port: int | None, timeout: float, context: ssl.SSLContext) -> None:
        super().__init__(host, port, timeout=timeout)
        self._tls = context

    def connect(self) -> None:
        """Connect, and do the handshake on a socket that is known already."""
        super().connect()
        encrypted = self._tls.wrap_socket(self.sock, server_hostname=self.host, do_handshake_on_connect=False)
        self.sock = encrypted
        encrypted.do_handshake()


class PersistentConnection:
    """One connection, which stays open from request to request and is opened again when the server has closed it.

    Parameters
    ----------
    url : str
        http(s)://host[:port][/path].
    headers : dict
        Of every request.
    timeout_s : float
        Time limit of one request and its response, s.
    ca_file : str, optional
        File of the certificates that the server's is checked against; None: the system's.
    clock : callable
        Returns monotonic seconds.
    """

    def __init__(
        self,
        url: str,
        headers: dict[str, str],
        timeout_s: float,
        ca_file: str | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._parts, self._timeout, self._ca_file, self._clock = urlsplit(url), timeout_s, ca_file, clock
        self._context = tls_context(ca_file) if is_encrypted(url) else None
        self._headers = headers
        self._connection: _PlainConnection | None = None
        self._answered, self._closed, self._busy = False, False, Lock()

    def request(self, method: str, path: str, body: bytes | None, headers: dict[str, str], limit: int) -> HttpAnswer:
        """Send one request and return its response, of `limit` bytes at most; raises Unreachable."""
        with self._busy:
            try:
                return self._request(method, path, body, headers, limit)
            finally:
                # While the host's name was being looked up, `close` found no socket to shut down.
                if self._closed:
                    self.drop()

    def _request(self, method: str, path: str, body: bytes | None, headers: dict[str, str], limit: int) -> HttpAnswer:
        fresh = self._connection is None
        try:
            return self._request_once(method, path, body, headers, limit)
        except (OSError, HTTPException, ValueError) as error:
            # A server may close an idle connection at any time: only a fresh one tells that it is out of reach.
            fresh = fresh and not (self._connection is not None and self._connection.interrupted)
            self.drop()
            if fresh or isinstance(error, TimeoutError):
                encrypted = self._context is not None
                raise Unreachable(cause_of(error, encrypted, self._ca_file, answered=self._answered)) from None
        return self._request(method, path, body, headers, limit)

    def drop(self) -> None:
        """Close the connection; the next request opens another."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    @contextmanager
    def in_step(self) -> Iterator[None]:
        """Drop the connection where the block finds that an answer is none: those of later requests may follow it."""
        try:
            yield
        except Unreachable:
            with self._busy:
                self.drop()
            raise

    def interrupt(self) -> None:
        """Send the request that waits for a response, if one does, once more on a fresh connection."""
        connection = self._connection
        if connection is not None:
            connection.interrupted = True
            connection.shut_down()

    def close(self) -> None:
        """Allow no more requests; the one under way fails at once."""
        self._closed = True
        connection = self._connection
        # A request under way has the lock until its time limit: its socket is shut down instead, which wakes it.
        if self._busy.acquire(blocking=False):
            self.drop()
            self._busy.release()
        elif connection is not None:
            connection.end()

    def _request_once(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str], limit: int
    ) -> HttpAnswer:
        connection = self._connection or self._open()
        deadline = self._clock() + self._timeout
        connection.request(method, self._parts.path.rstrip("/") + path, body, {**self._headers, **headers})
        response = connection.getresponse()
        self._answered = True
        data = self._read(response, limit, deadline)
        if response.will_close:
            self.drop()
        return HttpAnswer(response.status, data, response.headers)

    def _open(self) -> _PlainConnection:
        if self._closed:
            raise Unreachable("the link is closed")
        host, port = self._parts.hostname or "", self._parts.port
        if self._context is None:
            self._connection = _PlainConnection(host, port, timeout=self._timeout)
        else:
            self._connection = _TlsConnection(host, port, timeout=self._timeout, context=self._context)
        return self._connection

    def _read(self, response: HTTPResponse, limit: int, deadline: float) -> bytes:
        """Read the body; raise where it is longer than `limit` bytes, or not complete at the deadline."""
        pieces: list[bytes] = []
        size = 0
        while piece := response.read1(_PIECE):
            size += len(piece)
            if size > limit:
                raise HTTPException(f"a response of more than {limit} bytes")
            # The socket's time limit begins anew with every byte, so that a slow sender would occupy the thread for
            # ever.
            if self._clock() > deadline:
                raise TimeoutError("the response takes too long")
            pieces.append(piece)
        response.close()  # the connection is free for the next request only after this
        return b"".join(pieces)
