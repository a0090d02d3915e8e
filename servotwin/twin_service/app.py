"""The HTTP API: what an edge says and asks, what an operator reads, and how refusals look."""

from __future__ import annotations

import logging
from collections.abc import Callable, Coroutine
from contextlib import AbstractAsyncContextManager
from functools import partial
from typing import Any

import msgspec
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException

from servotwin.messages import Refusal
from servotwin.twin_service import openapi
from servotwin.twin_service.edge_api import EdgeApi
from servotwin.twin_service.limits import Disconnected
from servotwin.twin_service.metrics import Metrics
from servotwin.twin_service.read_api import ReadApi
from servotwin.twin_service.refused import Refused
from servotwin.twin_service.step_api import StepApi

log = logging.getLogger(__name__)

Endpoint = Callable[[Request], Coroutine[Any, Any, Response]]
Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]
SERVO = "/v1/servos/{servo}"
_DESCRIPTION = (
    """MessagePack in, MessagePack out; errors are JSON: {"code": ..., "detail": ...}. Times in s, angles in rad."""
)


def make_app(edge: EdgeApi, read: ReadApi, step: StepApi | None, metrics: Metrics, lifespan: Lifespan) -> FastAPI:
    """The application; `step` only where time is what requests say it is."""
    app = FastAPI(
        title="servotwin twin",
        version="1",
        description=_DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    for method, path, endpoint, says in _routes(edge, read, step):
        app.add_api_route(path, endpoint, methods=[method], openapi_extra=says, response_model=None)
    app.add_exception_handler(Refused, partial(refusal, metrics))
    app.add_exception_handler(HTTPException, partial(_no_such, metrics))
    app.add_exception_handler(RequestValidationError, partial(_no_such, metrics))
    app.add_exception_handler(Disconnected, _gone)
    return app


def _routes(edge: EdgeApi, read: ReadApi, step: StepApi | None) -> list[tuple[str, str, Endpoint, dict[str, Any]]]:
    window = SERVO + "/windows/{boot}/{sequence}"
    routes: list[tuple[str, str, Endpoint, dict[str, Any]]] = [
        ("PUT", window, edge.put_window, openapi.PUT_WINDOW),
        ("POST", SERVO + "/letters", edge.post_letter, openapi.POST_LETTER),
        ("GET", SERVO + "/outgoing", edge.get_outgoing, openapi.GET_OUTGOING),
        ("GET", "/v1/servos", read.servos, openapi.GET_SERVOS),
        ("GET", SERVO, read.servo, openapi.GET_SERVO),
        ("GET", SERVO + "/audit", read.audit, openapi.GET_AUDIT),
        ("GET", SERVO + "/events", read.events, openapi.GET_EVENTS),
        ("GET", window, read.window, openapi.GET_WINDOW),
        ("GET", "/healthz", read.health, openapi.GET_HEALTH),
        ("GET", "/metrics", read.metrics, openapi.GET_METRICS),
    ]
    if step is not None:
        routes += [
            ("POST", SERVO + "/lockstep/receive", step.receive, openapi.POST_RECEIVE),
            ("POST", SERVO + "/lockstep/wake", step.wake, openapi.POST_WAKE),
            ("GET", SERVO + "/lockstep/next", step.next, openapi.GET_NEXT),
        ]
    return routes


async def refusal(metrics: Metrics, request: Request, error: Exception) -> Response:
    """The answer to what was not taken; counted, and logged without what was sent."""
    assert isinstance(error, Refused)
    metrics.refused.add(error.refusal.value)
    about = {"servo": request.path_params.get("servo", "")[:64], "code": error.refusal.value, "why": error.detail}
    log.info("refused", extra={**about, "method": request.method, "status": error.status})
    headers = {"retry-after": "1"} if error.status in (429, 503) else {}
    if error.status == 401:
        headers["www-authenticate"] = "Bearer"
    if error.close:
        headers["connection"] = "close"
    return _json({"code": error.refusal.value, "detail": error.detail}, error.status, headers)


async def _no_such(metrics: Metrics, _request: Request, error: Exception) -> Response:
    """Neither a path nor a method of this API, or arguments that are none."""
    status = error.status_code if isinstance(error, HTTPException) else 400
    metrics.refused.add(Refusal.NOT_UNDERSTOOD.value)
    headers = dict(getattr(error, "headers", None) or {})
    return _json(
        {"code": Refusal.NOT_UNDERSTOOD.value, "detail": _WORDS.get(status, "not understood")}, status, headers
    )


async def _gone(_request: Request, _error: Exception) -> Response:
    """Nobody reads this."""
    return Response(status_code=400)


_WORDS = {404: "there is no such path", 405: "this path does not know that method"}


def _json(value: Any, status: int, headers: dict[str, str]) -> Response:
    return Response(msgspec.json.encode(value), status, headers, "application/json")
