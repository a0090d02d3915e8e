"""HTTP API of the edges: windows and letters in, sealed messages out."""

from __future__ import annotations

from collections.abc import Callable

from servotwin.messages import Refusal
from servotwin.store.records import PutResult
from servotwin.twin_service.auth import EdgeGate
from servotwin.twin_service.http_app import (
    BOOT,
    ENCODING,
    INTEGER,
    MESSAGE_ERRORS,
    MSGPACK,
    SECONDS,
    SEQUENCE,
    SERVO,
    HttpRequest,
    HttpResponse,
    HttpRoute,
    msgpack_response,
    operation,
    parameter,
)
from servotwin.twin_service.ingest import Ingest, acknowledgement
from servotwin.twin_service.limits import BodyReader, RequestRejected
from servotwin.twin_service.long_poll import MAX_WAIT_S, LongPolls, seal_messages

SERVO_PATH = "/v1/servos/{servo}"
WINDOW_PATH = SERVO_PATH + "/windows/{boot}/{sequence}"


class EdgeApi:
    """Routes of the edges.

    Parameters
    ----------
    gate : EdgeGate
    bodies : BodyReader
    ingest : Ingest
    polls : LongPolls
    wake : callable
        Wakes the dispatcher after a new message.
    """

    def __init__(
        self, gate: EdgeGate, bodies: BodyReader, ingest: Ingest, polls: LongPolls, wake: Callable[[], None]
    ) -> None:
        self._gate, self._bodies, self._ingest, self._polls, self._wake = gate, bodies, ingest, polls, wake

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        put_window = operation(
            "Commit a window",
            {
                201: ("New, and safe: an array with its acknowledgement.", MSGPACK),
                200: ("Known already, likewise.", MSGPACK),
            },
            parameters=(SERVO, BOOT, SEQUENCE, ENCODING),
            body="A window/1, MessagePack.",
            errors=MESSAGE_ERRORS,
        )
        post_letter = operation(
            "Commit a hello, receipt, fallback or answer",
            {202: ("It is safe.", None)},
            parameters=(SERVO, ENCODING),
            body="A hello/2, receipt/1, fallback/2 or answer/1, MessagePack; hello/1 and fallback/1 are read too.",
            errors=MESSAGE_ERRORS,
        )
        get_outgoing = operation(
            "Messages for an edge, sealed",
            {200: ("An array of sealed messages, serials rising; empty: none came in time.", MSGPACK)},
            parameters=(
                SERVO,
                parameter("after", INTEGER, "Only messages with higher serials."),
                parameter("wait", {**SECONDS, "maximum": MAX_WAIT_S}, "Longest wait for one, s."),
            ),
            errors=(400, 401, 403, 404, 429, 503),
        )
        return [
            HttpRoute("PUT", WINDOW_PATH, self._put_window, put_window),
            HttpRoute("POST", SERVO_PATH + "/letters", self._post_letter, post_letter),
            HttpRoute("GET", SERVO_PATH + "/outgoing", self._get_outgoing, get_outgoing),
        ]

    async def _put_window(self, request: HttpRequest) -> HttpResponse:
        """Commit a window, then acknowledge it: 201 if it is new, 200 if it is known."""
        servo = request.path["servo"]
        self._gate.admit(servo, request.token)
        body = await self._bodies.read(request.content_length, request.receive)
        incoming, window = self._ingest.read_window(servo, body, request.content_encoding)
        if (window.boot, str(window.sequence)) != (request.path["boot"], request.path["sequence"]):
            raise RequestRejected(Refusal.OTHER_NAME, f"the window is {incoming.key}, not what the address says")
        new = await self._ingest.commit(incoming) is PutResult.NEW
        if new:
            self._wake()
        return msgpack_response([acknowledgement(window)], 201 if new else 200)

    async def _post_letter(self, request: HttpRequest) -> HttpResponse:
        """Commit a hello, receipt, fallback or answer: 202."""
        servo = request.path["servo"]
        self._gate.admit(servo, request.token)
        body = await self._bodies.read(request.content_length, request.receive)
        incoming, _ = self._ingest.read_letter(servo, body, request.content_encoding)
        if await self._ingest.commit(incoming) is PutResult.NEW:
            self._wake()
        return HttpResponse(202)

    async def _get_outgoing(self, request: HttpRequest) -> HttpResponse:
        """Sealed messages with serials above `after`, as soon as there are some; none after `wait` s."""
        servo = request.path["servo"]
        self._gate.admit(servo, request.token, limited=False)
        after, wait = request.integer("after", 0), request.seconds("wait", 0.0)
        if wait > MAX_WAIT_S:
            detail = f"wait = {wait:g} s: at most {MAX_WAIT_S:g} s are allowed"
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, detail)
        messages = await self._polls.messages(servo, after, wait)
        return msgpack_response(seal_messages(self._gate.verifier(servo), servo, messages))
