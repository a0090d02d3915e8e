"""HTTP API of engineers' acts: hold, release, roll back, ask first, approve. Each is stored before the twin does it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Annotated, Any
from uuid import uuid4

import msgspec

from servotwin.dashboard.oversight import machine_oversight
from servotwin.messages import InvalidMessage, Refusal
from servotwin.messages.acts import MAX_ACT_BYTES, Act, ActKind, encode_act
from servotwin.store.engine import StoreBusy, StoreUnavailable
from servotwin.store.integrity import message_digest
from servotwin.store.records import Incoming, MessageKind, PutResult
from servotwin.store.store import Store
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_edge import SERVO_PATH
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse, json_response
from servotwin.twin_service.http_operator import admitted_servo, store_query
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.limits import RateLimiter, RequestRejected
from servotwin.twin_service.openapi import JSON, QUERY_ERRORS, SERVO, operation
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.store_executor import StoreExecutor, unavailable

_BODY_S = 10.0
_RATE, _BURST = 1.0, 20.0
"""Acts of one engineer: per s, and at once."""
_FRESH = {"cache-control": "no-store", "x-content-type-options": "nosniff"}


class ActRequest(msgspec.Struct, forbid_unknown_fields=True):
    """Body of an act; the fields of `messages.acts.Act`."""

    act: ActKind
    why: str
    version: int | None = None
    window: Annotated[list[str | int], msgspec.Meta(min_length=2, max_length=2)] | None = None


class ActsApi:
    """Routes of acts: operators read them, engineers do them.

    Parameters
    ----------
    operators : OperatorAccess
    store : Store
    readers : StoreExecutor
    put : callable
        Commits a message.
    wake : callable
        Called where there is new work.
    wall, monotonic : callable
        s.
    """

    def __init__(
        self,
        operators: OperatorAccess,
        store: Store,
        readers: StoreExecutor,
        put: Callable[[Incoming], Awaitable[PutResult]],
        wake: Callable[[], None],
        wall: Callable[[], float],
        monotonic: Callable[[], float],
    ) -> None:
        self._operators, self._store, self._readers = operators, store, readers
        self._put, self._wake, self._wall = put, wake, wall
        self._bodies = BodyReader(MAX_ACT_BYTES, _BODY_S)
        self._limit = RateLimiter(_RATE, _BURST, monotonic, "acts", "engineer")

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        read = operation(
            "Oversight of a machine: who holds it and why, the proposal that waits, and all acts",
            {200: ("held, ask_first, proposal, acts; may_act: this reader may act.", JSON)},
            (SERVO,),
            errors=QUERY_ERRORS,
        )
        do = operation(
            "An engineer's act: hold, release, roll back, ask first, ask no more, approve",
            {202: ("It is stored; the twin does it next, and keeps whether it was refused.", JSON)},
            (SERVO,),
            body="act; why: the reason; version: to roll back to, null: the fallback set; window: boot and sequence "
            "of the proposal that is approved.",
            body_type=JSON,
            errors=(400, 401, 403, 404, 413, 429, 503),
        )
        path = SERVO_PATH + "/acts"
        return [HttpRoute("GET", path, self._get, read), HttpRoute("POST", path, self._post, do)]

    async def _get(self, request: HttpRequest) -> HttpResponse:
        servo, name = admitted_servo(self._operators, request), self._operators.check(request)
        read = partial(self._store.reading, lambda connection: machine_oversight(connection, servo), servo)
        found: dict[str, Any] = await store_query(self._readers, read)
        return json_response({**found, "may_act": self._operators.may_act(name)}, headers=_FRESH)

    async def _post(self, request: HttpRequest) -> HttpResponse:
        who, servo = self._operators.check_engineer(request), admitted_servo(self._operators, request)
        self._limit.take(who)
        act = _act(servo, who, await self._bodies.read(request.content_length, request.receive), self._wall())
        if await store_query(self._readers, partial(self._store.servo, servo)) is None:
            raise RequestRejected(Refusal.UNKNOWN_SERVO, f"servo {servo!r} has never sent a message")
        body = encode_act(act)
        try:
            await self._put(
                Incoming(servo, MessageKind.ACT, f"act {uuid4().hex}", body, "", message_digest(body), act.time)
            )
        except (StoreBusy, StoreUnavailable) as error:
            raise unavailable(error, "the store cannot be written now: nothing was done") from None
        self._wake()
        return json_response({"act": act.act, "who": who}, 202, _FRESH)


def _act(servo: str, who: str, body: bytes, now: float) -> Act:
    """Read the body of a request; raises RequestRejected."""
    try:
        asked = msgspec.json.decode(body, type=ActRequest)
        fields = {"act": asked.act, "why": asked.why.strip(), "version": asked.version, "window": asked.window}
        named = {key: value for key, value in fields.items() if value is not None}
        return msgspec.convert({"type": "act/1", "servo": servo, "who": who, "time": now, **named}, Act)
    except InvalidMessage as error:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, str(error)) from None
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"the act is not understood: {error}"[:300]) from None
