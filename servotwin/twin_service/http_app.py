"""HTTP application: routes, requests, responses, error bodies and `/openapi.json`, as one ASGI callable.

No framework: its layers take longer for the PUT of a window than checking and committing the window do.
"""

from __future__ import annotations

import asyncio
import ipaddress
import math
import re
import traceback
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable, Mapping, MutableMapping
from contextlib import AbstractAsyncContextManager
from http.cookies import CookieError, SimpleCookie
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

import msgspec

from servotwin.link.body_mark import body_mark
from servotwin.messages import Refusal
from servotwin.messages.codec import ENCODINGS
from servotwin.twin_service.auth import bearer_token
from servotwin.twin_service.limits import Disconnected, Receive, RequestRejected
from servotwin.twin_service.openapi import JSON, MAX_INTEGER, MSGPACK, Operation, openapi_document
from servotwin.twin_service.refusals import Refusals

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
_Lifespan = Callable[[], AbstractAsyncContextManager[None]]

_SAFE = ("GET", "HEAD")
_DOMAIN = "host {!r}: a twin without tokens answers under localhost, an address or a name without a dot only"
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
Handler = Callable[[HttpRequest], Awaitable[AnyResponse]]


class HttpRoute(NamedTuple):
    """Declaration of one route.

    Attributes
    ----------
    method, path : str
        "GET", "/v1/servos/{servo}": a name in braces matches one segment.
    handler : callable
    operation : dict
        Its OpenAPI operation object, as `operation` makes it.
    """

    method: str
    path: str
    handler: Handler
    operation: Operation


class HttpApp:
    """ASGI application of routes.

    A handler rejects a request by raising RequestRejected. Any other exception is the server's to log and to answer
    with status 500.

    Parameters
    ----------
    routes : iterable of HttpRoute
    refusals : Refusals
        Counts, logs and slows rejections.
    lifespan : callable
        Context manager that is entered before the first request and left after the last.
    own_names : bool
        Refuse requests under a domain's name, as a page of that domain can send them once its name leads here (DNS
        rebinding): where no token protects the service.
    """

    def __init__(
        self,
        routes: Iterable[HttpRoute],
        refusals: Refusals,
        lifespan: _Lifespan,
        own_names: bool = False,
    ) -> None:
        self._refusals, self.lifespan, self._own_names = refusals, lifespan, own_names
        declared = list(routes)
        # Encoded once: the routes do not change.
        document = msgspec.json.encode(
            openapi_document((route.method, route.path, route.operation) for route in declared)
        )

        async def openapi(_request: HttpRequest) -> HttpResponse:
            return HttpResponse(200, document, JSON)

        methods: dict[str, dict[str, Handler]] = {"/openapi.json": {"GET": openapi}}
        for route in declared:
            methods.setdefault(route.path, {})[route.method] = route.handler
        self._routes = [(_pattern(path), handlers) for path, handlers in methods.items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._run_lifespan(receive, send)
            return
        try:
            response = await self._respond(scope, receive)
        except Disconnected:
            return
        await response.send(send)

    async def _respond(self, scope: Scope, receive: Receive) -> AnyResponse:
        for pattern, handlers in self._routes:
            match = pattern.fullmatch(scope["path"])
            if match is None:
                continue
            handler = handlers.get(scope["method"])
            if handler is None:
                allowed = {"allow": ", ".join(sorted(handlers))}
                return await self._no_route(scope, receive, 405, "this path does not know that method", allowed)
            request = HttpRequest(scope, receive, match.groupdict())
            try:
                if self._own_names and _is_domain(request.host):
                    raise RequestRejected(Refusal.NOT_UNDERSTOOD, _DOMAIN.format(request.host[:64]), 403)
                if scope["method"] not in _SAFE and request.foreign:
                    raise RequestRejected(Refusal.NOT_UNDERSTOOD, "the request comes from a page of another site", 403)
                return await handler(request)
            except RequestRejected as rejected:
                return await self._rejection(request, rejected)
        return await self._no_route(scope, receive, 404, "there is no such path")

    async def _no_route(
        self, scope: Scope, receive: Receive, status: int, detail: str, headers: Mapping[str, str] | None = None
    ) -> HttpResponse:
        code = Refusal.NOT_UNDERSTOOD
        self._refusals.count(code)
        await self._hold_back(HttpRequest(scope, receive, {}))
        return json_response({"code": code.value, "detail": detail}, status, headers)

    async def _rejection(self, request: HttpRequest, rejected: RequestRejected) -> HttpResponse:
        """Error body; the rejection is counted, and logged without the body of the request."""
        code, status = rejected.refusal.value, rejected.status
        servo, shown = request.path.get("servo", "")[:64], request.token is not None
        about = {"why": rejected.detail, "method": request.method, "status": status}
        self._refusals.log(rejected.refusal, servo, shown, **about)
        await self._hold_back(request)
        headers = {"retry-after": "1"} if status in (429, 503) else {}
        if status == 401:
            headers["www-authenticate"] = "Bearer"
        if rejected.close:
            headers["connection"] = "close"
        mark = {"mark": rejected.mark} if rejected.mark else {}
        return json_response({"code": code, "detail": rejected.detail, **mark}, status, headers)

    async def _hold_back(self, request: HttpRequest) -> None:
        await self._refusals.hold_back(self._refusals.sender(request.token, request.address))

    async def _run_lifespan(self, receive: Receive, send: Send) -> None:
        phase = "startup"
        await receive()
        try:
            async with self.lifespan():
                await send({"type": "lifespan.startup.complete"})
                phase = "shutdown"
                await receive()
        except BaseException:
            await send({"type": f"lifespan.{phase}.failed", "message": traceback.format_exc()})
            raise
        await send({"type": "lifespan.shutdown.complete"})


def _is_domain(host: str) -> bool:
    """True for a name that anybody may own: one with a dot that is no address."""
    if host.endswith(".localhost") or "." not in host:
        return False
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return True
    return False


def _pattern(path: str) -> re.Pattern[str]:
    """Regular expression of a path with {names}."""
    literals = re.split(r"\{(\w+)\}", path)
    parts = (f"(?P<{part}>[^/]+)" if i % 2 else re.escape(part) for i, part in enumerate(literals))
    return re.compile("".join(parts))
