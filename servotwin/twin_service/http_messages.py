"""HTTP requests and responses of the ASGI application: whole ones, and streams."""

from __future__ import annotations

import asyncio
import ipaddress
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qsl

import msgspec

from servotwin.link.body_mark import body_mark
from servotwin.messages import Refusal
from servotwin.messages.codec import ENCODINGS
from servotwin.twin_service.auth import bearer_token
from servotwin.twin_service.limits import Receive, RequestRejected
from servotwin.twin_service.openapi import JSON, MAX_INTEGER, MSGPACK

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

ABORT = "servotwin.abort"
"""Extension of a scope: a callable that ends the connection at once."""
_STALL_S, _LAST_S = 10.0, 1.0
"""s that a part of a stream may take to be sent: then its client does not read; s for the rest when streams end."""
_UNBUFFERED = (b"x-accel-buffering", b"no")
"""Header that keeps a proxy from collecting the parts of a stream."""
_pack = msgspec.msgpack.Encoder().encode


def _no_connection() -> None:
    """End of a connection that this server does not hold itself."""


def cookie_of(header: bytes | None, name: str) -> str | None:
    """Cookie in a Cookie header; None: there is none of that name."""
    try:
        jar = SimpleCookie((header or b"").decode("latin-1"))
    except CookieError:
        return None
    return jar[name].value if name in jar else None


class HttpRequest:
    """One request.

    Attributes
    ----------
    method : str
    address : str
        Of the client, or of the proxy before it; empty: unknown.
    path : dict of str to str
        Parameters in the path, percent-decoded.
    receive : callable
        ASGI's: the next event of the request, for `BodyReader`.
    abort : callable
        Ends the connection at once, whatever is still to be sent.
    """

    __slots__ = ("_headers", "_query", "_query_string", "abort", "address", "method", "path", "receive")

    def __init__(self, scope: Scope, receive: Receive, path: dict[str, str]) -> None:
        self.method, self.path, self.receive = scope["method"], path, receive
        self.address: str = (scope.get("client") or ("",))[0]
        self.abort: Callable[[], None] = scope.get("extensions", {}).get(ABORT, _no_connection)
        self._headers, self._query_string = scope["headers"], scope["query_string"]
        self._query: dict[str, str] | None = None

    def header(self, name: bytes) -> bytes | None:
        """The first header of that lower-case name."""
        return next((value for key, value in self._headers if key == name), None)

    @property
    def token(self) -> bytes | None:
        """Bearer token; None: there is none."""
        return bearer_token(self.header(b"authorization"))

    def cookie(self, name: str) -> str | None:
        """A cookie; None: there is none of that name."""
        return cookie_of(self.header(b"cookie"), name)

    @property
    def foreign(self) -> bool:
        """True where a browser sends it for a page of another site."""
        # A browser says it itself, except on plain HTTP: there is no proxy then that would change the host.
        site = self.header(b"sec-fetch-site")
        if site is not None:
            return site not in (b"same-origin", b"none")
        origin = self.header(b"origin")
        return origin is not None and origin.partition(b"://")[2] != self.header(b"host")

    @property
    def host(self) -> str:
        """Name or address in the Host header, without the port."""
        text = (self.header(b"host") or b"").decode("latin-1").strip()
        name = text.partition("]")[0].removeprefix("[") if text.startswith("[") else text.rpartition(":")[0] or text
        return name.lower().rstrip(".")

    @property
    def claim(self) -> str:
        """Claim that the sender holds; "": it names none."""
        return (self.header(b"servotwin-claim") or b"").decode("latin-1")

    @property
    def waiting(self) -> int:
        """Number of windows that the edge has to send beside this one; 0 where it does not say."""
        text = self.header(b"servotwin-waiting") or b""
        return int(text) if text.isdigit() and len(text) <= 16 else 0

    @property
    def content_length(self) -> str | None:
        """Content-Length as sent."""
        value = self.header(b"content-length")
        return None if value is None else value.decode("latin-1")

    def mark_of(self, body: bytes) -> str:
        """`body_mark` of its body."""
        return body_mark(body, (self.header(b"content-encoding") or b"").decode("latin-1"))

    @property
    def content_encoding(self) -> str:
        """Compression of the body; raises RequestRejected where it is unknown."""
        encoding = (self.header(b"content-encoding") or b"").decode("latin-1")
        if encoding in ENCODINGS:
            return encoding
        if encoding == "identity":
            return ""
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, "content-encoding: known are identity, deflate and zstd")

    def argument(self, key: str) -> str | None:
        """An argument of the query; the last one where there are several."""
        if self._query is None:
            self._query = dict(parse_qsl(self._query_string.decode("latin-1"), keep_blank_values=True))
        return self._query.get(key)

    def integer(self, key: str, default: int | None = None) -> int:
        """An argument of the query, an integer from 0 to 2**53; raises RequestRejected."""
        text = self.argument(key)
        if text is None and default is not None:
            return default
        digits = text is not None and text.isascii() and text.isdecimal() and len(text) <= 16
        if text is None or not (digits and int(text) <= MAX_INTEGER):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"{key}: give a whole number from 0 to {MAX_INTEGER}")
        return int(text)

    def seconds(self, key: str, default: float | None = None) -> float:
        """An argument of the query, a time in s; raises RequestRejected."""
        text = self.argument(key)
        if text is None and default is not None:
            return default
        try:
            value = float(text or "")
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value >= 0.0):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"{key}: give a time in s, finite and at least 0")
        return value


class HttpResponse:
    """Status, headers and body of a response."""

    __slots__ = ("body", "headers", "status")

    def __init__(
        self,
        status: int = 200,
        body: bytes = b"",
        content_type: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        self.status, self.body = status, body
        self.headers = [(key.encode("latin-1"), value.encode("latin-1")) for key, value in (headers or {}).items()]
        self.headers.append((b"content-length", b"%d" % len(body)))
        if content_type is not None:
            self.headers.append((b"content-type", content_type.encode("latin-1")))

    async def send(self, send: Send) -> None:
        """Send it."""
        await send({"type": "http.response.start", "status": self.status, "headers": self.headers})
        await send({"type": "http.response.body", "body": self.body})


class HttpStream:
    """Response whose body comes in parts, until they end, the client goes or no longer reads.

    Parameters
    ----------
    parts : asynchronous iterator of bytes
        Closed in the end, whatever happens.
    content_type : str
    request : HttpRequest
        Its `receive` tells when the client has gone; a client that does not read is sent away by its `abort`.
    ended : asyncio.Event
        Set where the parts end soon, so that nobody waits long for a client that does not take the last ones.
    """

    __slots__ = ("_content_type", "_ended", "_parts", "_request")

    def __init__(
        self, parts: AsyncGenerator[bytes, None], content_type: str, request: HttpRequest, ended: asyncio.Event
    ) -> None:
        self._parts, self._content_type, self._request, self._ended = parts, content_type, request, ended

    async def send(self, send: Send) -> None:
        """Send the parts as they come."""
        headers = [(b"content-type", self._content_type.encode()), (b"cache-control", b"no-store"), _UNBUFFERED]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        sending = asyncio.create_task(self._send_parts(send))
        tasks = sending, asyncio.create_task(self._until_gone()), asyncio.create_task(self._until_overdue())
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            finished = sending.done() and sending.exception() is None
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await self._parts.aclose()
            if not finished:
                self._request.abort()

    async def _until_gone(self) -> None:
        while (await self._request.receive())["type"] != "http.disconnect":
            pass

    async def _until_overdue(self) -> None:
        await self._ended.wait()
        await asyncio.sleep(_LAST_S)

    async def _send_parts(self, send: Send) -> None:
        async for part in self._parts:
            async with asyncio.timeout(_STALL_S):
                await send({"type": "http.response.body", "body": part, "more_body": True})
        async with asyncio.timeout(_STALL_S):
            await send({"type": "http.response.body", "body": b""})


def msgpack_response(value: object, status: int = 200, headers: Mapping[str, str] | None = None) -> HttpResponse:
    """Response in MessagePack."""
    return HttpResponse(status, _pack(value), MSGPACK, headers)


def json_response(value: object, status: int = 200, headers: Mapping[str, str] | None = None) -> HttpResponse:
    """Response in JSON."""
    return HttpResponse(status, msgspec.json.encode(value), JSON, headers)


AnyResponse = HttpResponse | HttpStream


def is_domain(host: str) -> bool:
    """True for a name that anybody may own: one with a dot that is no address."""
    if host.endswith(".localhost") or "." not in host:
        return False
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return True
    return False
