"""HTTP application: routes, requests, responses, error bodies and `/openapi.json`, as one ASGI callable.

No framework: its layers take longer for the PUT of a window than checking and committing the window do.
"""

from __future__ import annotations

import asyncio
import re
import traceback
from collections.abc import Awaitable, Callable, Iterable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import NamedTuple

import msgspec

from servotwin.messages import Refusal
from servotwin.twin_service.http_messages import (
    AnyResponse,
    HttpRequest,
    HttpResponse,
    Scope,
    Send,
    is_domain,
    json_response,
)
from servotwin.twin_service.limits import Disconnected, Receive, RequestRejected
from servotwin.twin_service.openapi import JSON, Operation, openapi_document
from servotwin.twin_service.refusals import Refusals

_Lifespan = Callable[[], AbstractAsyncContextManager[None]]

_SAFE = ("GET", "HEAD")
_DOMAIN = "host {!r}: a twin without tokens answers under localhost, an address or a name without a dot only"
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
                if self._own_names and is_domain(request.host):
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
        except asyncio.CancelledError:
            return  # by a second interrupt, after which the server waits for nothing: it would log a traceback
        except BaseException:
            await send({"type": f"lifespan.{phase}.failed", "message": traceback.format_exc()})
            raise
        await send({"type": "lifespan.shutdown.complete"})


def _pattern(path: str) -> re.Pattern[str]:
    """Regular expression of a path with {names}."""
    literals = re.split(r"\{(\w+)\}", path)
    parts = (f"(?P<{part}>[^/]+)" if i % 2 else re.escape(part) for i, part in enumerate(literals))
    return re.compile("".join(parts))
