"""The two requests that come by the thousand, past what a framework does for every request.

FastAPI describes the PUT of a window and an edge's question for messages, and could serve them; its layers take longer
for one than checking and committing do. So they are recognised before them, and the very same functions are called.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable

from fastapi import FastAPI, Request, Response
from starlette.types import Receive, Scope, Send

from servotwin.twin_service.limits import Disconnected
from servotwin.twin_service.refused import Refused

Endpoint = Callable[[Request], Awaitable[Response]]
WINDOW = re.compile(r"/v1/servos/(?P<servo>[^/]+)/windows/(?P<boot>[^/]+)/(?P<sequence>[^/]+)")
OUTGOING = re.compile(r"/v1/servos/(?P<servo>[^/]+)/outgoing")


class Shortcut:
    """An ASGI application around the API.

    Parameters
    ----------
    api : FastAPI
        Everything else, begin and end included.
    put, ask : callable
        The endpoints of windows, and of messages for an edge.
    refuse : callable
        The answer where one of them raises Refused.
    """

    def __init__(
        self,
        api: FastAPI,
        put: Endpoint,
        ask: Endpoint,
        refuse: Callable[[Request, Refused], Awaitable[Response]],
    ) -> None:
        self.api, self._refuse = api, refuse
        self._ways = {"PUT": (WINDOW, put), "GET": (OUTGOING, ask)}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        way = self._ways.get(scope["method"]) if scope["type"] == "http" else None
        found = None if way is None else way[0].fullmatch(scope["path"])
        if way is None or found is None:
            await self.api(scope, receive, send)
            return
        scope["path_params"] = found.groupdict()
        request = Request(scope, receive)
        try:
            response = await way[1](request)
        except Refused as refused:
            response = await self._refuse(request, refused)
        except Disconnected:
            return
        await response(scope, receive, send)
