"""HTTP API of the dashboard's simulated steps."""

from __future__ import annotations

from collections.abc import Callable

from servotwin.twin_service.http_app import HttpRequest, HttpResponse, HttpRoute
from servotwin.twin_service.http_edge import SERVO_PATH
from servotwin.twin_service.http_operator import admitted_servo
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.limits import RateLimiter
from servotwin.twin_service.openapi import JSON, SERVO, operation
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.what_if_process import WhatIfProcess

_BODY_BYTES, _BODY_S = 4096, 10.0
_RATE, _BURST = 20.0, 40.0
"""Simulated steps of one operator: per s, and at once."""


class WhatIfApi:
    """Route of simulated steps: an operator's token is enough, nothing is stored or changed.

    Parameters
    ----------
    operators : OperatorAccess
    process : WhatIfProcess
    monotonic : callable
        s.
    """

    def __init__(self, operators: OperatorAccess, process: WhatIfProcess, monotonic: Callable[[], float]) -> None:
        self._operators, self._process = operators, process
        self._bodies = BodyReader(_BODY_BYTES, _BODY_S)
        self._limit = RateLimiter(_RATE, _BURST, monotonic, "simulated steps", "operator")

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        described = operation(
            "A step of the machine's model with another gap, dead zone or gains",
            {200: ("The simulated step, decimated for a screen; SI units.", JSON)},
            (SERVO,),
            body="gap, and optionally tolerance or k_dz, gains, step, duration; SI units.",
            body_type=JSON,
            errors=(400, 401, 403, 413, 429, 503),
        )
        return [HttpRoute("POST", SERVO_PATH + "/what-if", self._post, described)]

    async def _post(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        self._limit.take(self._operators.check(request))
        body = await self._bodies.read(request.content_length, request.receive)
        answer = await self._process.answer(servo, body)
        return HttpResponse(200, answer, JSON, {"cache-control": "no-store", "x-content-type-options": "nosniff"})
