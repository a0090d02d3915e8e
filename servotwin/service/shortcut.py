"""The one request that comes by the thousand, past what a framework does for every request.

FastAPI describes the PUT of a window and could serve it; its layers take as long for one as checking and committing do.
So it is recognised before them, and the very same function is called.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable

from fastapi import FastAPI, Request, Response
from starlette.types import Receive, Scope, Send

from servotwin.service.limits import Disconnected
from servotwin.service.refused import Refused

WINDOW = re.compile(r"/v1/servos/(?P<servo>[^/]+)/windows/(?P<boot>[^/]+)/(?P<sequence>[^/]+)")


class Shortcut:
    """An ASGI application around the API.

    Parameters
    ----------
    api : FastAPI
        Everything else, begin and end included.
    put : callable
        The endpoint of windows.
    refuse : callable
        The answer where that raises Refused.
    """

    def __init__(
        self,
        api: FastAPI,
        put: Callable[[Request], Awaitable[Response]],
        refuse: Callable[[Request, Refused], Awaitable[Response]],
    ) -> None:
        self.api, self._put, self._refuse = api, put, refuse

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        found = WINDOW.fullmatch(scope["path"]) if scope["type"] == "http" and scope["method"] == "PUT" else None
        if found is None:
            await self.api(scope, receive, send)
            return
        scope["path_params"] = found.groupdict()
        request = Request(scope, receive)
        try:
            response = await self._put(request)
        except Refused as refused:
            response = await self._refuse(request, refused)
        except Disconnected:
            return
        await response(scope, receive, send)
