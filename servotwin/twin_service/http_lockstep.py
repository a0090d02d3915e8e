"""HTTP API of lock-step: a request gives the time, and its response comes when all that follows is committed."""

from __future__ import annotations

import asyncio
from collections import defaultdict

from servotwin.messages import Refusal, WindowMessage
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import PutResult
from servotwin.store.store import Store
from servotwin.twin_service.auth import EdgeGate
from servotwin.twin_service.dispatcher import Dispatcher, NoResult
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_edge import SERVO_PATH
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse, msgpack_response
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.ingest import Ingest, acknowledgement, end_of
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.openapi import (
    ENCODING,
    MESSAGE_ERRORS,
    MSGPACK,
    QUERY_ERRORS,
    SECONDS,
    SERVO,
    operation,
    parameter,
)
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.worker import WorkerLost


class LockstepApi:
    """Routes of lock-step: messages are stored, leased, worked on and committed as always, but within one request.

    Parameters
    ----------
    gate, bodies, ingest : EdgeGate, BodyReader, Ingest
    store, executor : Store, StoreExecutor
    dispatcher : Dispatcher
        Not running: nothing happens except on request.
    """

    def __init__(
        self,
        gate: EdgeGate,
        bodies: BodyReader,
        ingest: Ingest,
        store: Store,
        executor: StoreExecutor,
        dispatcher: Dispatcher,
    ) -> None:
        self._gate, self._bodies, self._ingest = gate, bodies, ingest
        self._store, self._executor, self._dispatcher = store, executor, dispatcher
        self._locks: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        stepped = {200: ("The twin's messages, and when it is to be woken.", MSGPACK)}
        now = parameter("now", SECONDS, "Sample time, s.", required=True)
        receive = operation(
            "Lock-step: a message arrives",
            stepped,
            parameters=(SERVO, now, ENCODING),
            body="Any message for a twin.",
            errors=MESSAGE_ERRORS,
        )
        wake = operation("Lock-step: wake the twin", stepped, (SERVO, now), errors=QUERY_ERRORS)
        following = operation(
            "Lock-step: time of the next wake-up",
            {200: ("Sample time, s, or null.", MSGPACK)},
            parameters=(SERVO,),
            errors=QUERY_ERRORS,
        )
        path = SERVO_PATH + "/lockstep"
        return [
            HttpRoute("POST", path + "/receive", self._receive, receive),
            HttpRoute("POST", path + "/wake", self._wake, wake),
            HttpRoute("GET", path + "/next", self._next, following),
        ]

    async def _receive(self, request: HttpRequest) -> HttpResponse:
        """A message arrives `now`: returns the twin's messages, an acknowledgement first, and its next wake-up."""
        servo = self._admitted_servo(request)
        now = request.seconds("now")
        body = await self._bodies.read(request.content_length, request.receive)
        incoming, message = self._ingest.read(servo, body, request.content_encoding)
        # One sample of tolerance: a window that ends with the present sample is not from the future.
        if isinstance(message, WindowMessage) and end_of(message) > now + 1.0 / message.rate:
            detail = f"the window ends at {end_of(message):g} s, after now = {now:g} s"
            raise RequestRejected(Refusal.FUTURE, detail)
        async with self._locks[servo]:
            new = await self._ingest.commit(incoming._replace(received=now), message) is PutResult.NEW
            sent = await self._process(servo, now) if new else []
        first = [acknowledgement(message)] if isinstance(message, WindowMessage) else []
        return await self._response(servo, first + sent)

    async def _wake(self, request: HttpRequest) -> HttpResponse:
        """Wake the twin at `now`: returns the messages that it sends by itself, and its next wake-up."""
        servo = self._admitted_servo(request)
        now = request.seconds("now")
        async with self._locks[servo]:
            sent = await self._process(servo, now)
        return await self._response(servo, sent)

    async def _next(self, request: HttpRequest) -> HttpResponse:
        """Time at which the twin is to be woken, s; null: never."""
        return msgpack_response(await self._next_wake(self._admitted_servo(request)))

    def _admitted_servo(self, request: HttpRequest) -> str:
        servo = request.path["servo"]
        self._gate.admit(servo, request.token, limited=False)
        return servo

    async def _response(self, servo: str, sent: list[bytes]) -> HttpResponse:
        return msgpack_response({"messages": sent, "wake": await self._next_wake(servo)})

    async def _next_wake(self, servo: str) -> float | None:
        summary = await self._executor.run(lambda: self._store.servo(servo))
        return None if summary is None else summary.wake

    async def _process(self, servo: str, now: float) -> list[bytes]:
        try:
            return await self._dispatcher.process(servo, now)
        except (NoResult, StoreUnavailable, WorkerLost):
            detail = "the message is stored but could not be processed now"
            raise RequestRejected(Refusal.UNAVAILABLE, detail) from None
