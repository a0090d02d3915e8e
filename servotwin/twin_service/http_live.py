"""HTTP API of live views: columns from edges whose files allow it, and to the pages that watch."""

from __future__ import annotations

from servotwin.messages import Refusal
from servotwin.messages.live import MAX_LIVE_BYTES, Watched, encode_live
from servotwin.twin_service.auth import EdgeGate
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_edge import MAX_WAIT_S, SERVO_PATH
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse, json_response
from servotwin.twin_service.http_operator import admitted_servo
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.live_views import LiveIntake, LiveViews
from servotwin.twin_service.openapi import (
    CLAIM,
    INTEGER,
    JSON,
    MSGPACK,
    QUERY_ERRORS,
    SECONDS,
    SERVO,
    operation,
    parameter,
)
from servotwin.twin_service.sessions import OperatorAccess

_BODY_S = 10.0


class LiveApi:
    """Routes of live views; nothing is stored.

    Parameters
    ----------
    gate : EdgeGate
    operators : OperatorAccess
    intake : LiveIntake
    views : LiveViews
    """

    def __init__(self, gate: EdgeGate, operators: OperatorAccess, intake: LiveIntake, views: LiveViews) -> None:
        self._gate, self._operators, self._intake, self._views = gate, operators, intake, views
        self._bodies = BodyReader(MAX_LIVE_BYTES, _BODY_S)

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        sent = operation(
            "Columns of a live view, from an edge whose file allows it",
            {200: ("A watched/1: whether somebody watches, so that the edge goes on.", MSGPACK)},
            (SERVO, parameter("wait", {**SECONDS, "maximum": MAX_WAIT_S}, "Longest wait for a watcher, s."), CLAIM),
            body="A live/1, MessagePack; without columns it waits until somebody watches.",
            errors=(400, 401, 403, 404, 409, 413, 429, 503),
        )
        shown = operation(
            "Newest columns of a live view; asking for them makes the edge stream for some seconds",
            {
                200: (
                    "state: off, away, waiting, live or stale; columns: least and greatest position, error and command "
                    "of each; SI units.",
                    JSON,
                )
            },
            (
                SERVO,
                parameter("boot", INTEGER, "Boot of the newest column that is known."),
                parameter("after", INTEGER, "Number of that column."),
            ),
            errors=(*QUERY_ERRORS, 429),
        )
        return [
            HttpRoute("POST", SERVO_PATH + "/live", self._post, sent),
            HttpRoute("GET", SERVO_PATH + "/live", self._get, shown),
        ]

    async def _post(self, request: HttpRequest) -> HttpResponse:
        servo = request.path["servo"]
        self._gate.admit(servo, request.token, limited=False)
        wait = request.seconds("wait", 0.0)
        if wait > MAX_WAIT_S:
            detail = f"wait = {wait:g} s: at most {MAX_WAIT_S:g} s are allowed"
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, detail)
        await self._intake.admit(servo, request.claim)
        body = await self._bodies.read(request.content_length, request.receive)
        watched = await self._intake.take(servo, body, wait)
        return HttpResponse(200, encode_live(Watched(watched)), MSGPACK)

    async def _get(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        shown = self._views.look(servo, request.integer("boot", 0), request.integer("after", 0))
        return json_response(shown, headers={"cache-control": "no-store", "x-content-type-options": "nosniff"})
