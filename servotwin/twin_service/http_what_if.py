"""HTTP API of what the dashboard has computed on request: simulated steps, and residuals of stored windows."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import msgspec

from servotwin.messages import MAX_BYTES, InvalidMessage, Refusal
from servotwin.messages.codec import decompress
from servotwin.store.records import StoredMessage
from servotwin.store.store import Store
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_edge import SERVO_PATH, WINDOW_PATH
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse
from servotwin.twin_service.http_operator import admitted_servo, store_query, stored_window
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.limits import RateLimiter, RequestRejected
from servotwin.twin_service.openapi import BOOT, JSON, QUERY_ERRORS, SEQUENCE, SERVO, operation
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.what_if_process import QuestionKind, WhatIfProcess

_BODY_BYTES, _BODY_S = 4096, 10.0
_NOT_ESTIMATED = "this window was not estimated: screening was enough, or it waits for its turn"
_RATE, _BURST = 20.0, 40.0
"""Simulated steps of one operator: per s, and at once."""


class WhatIfApi:
    """Routes of simulated steps and residuals: an operator's token is enough, nothing is stored or changed.

    Parameters
    ----------
    operators : OperatorAccess
    store, executor : Store, StoreExecutor
    process : WhatIfProcess
    monotonic : callable
        s.
    """

    def __init__(
        self,
        operators: OperatorAccess,
        store: Store,
        executor: StoreExecutor,
        process: WhatIfProcess,
        monotonic: Callable[[], float],
    ) -> None:
        self._operators, self._store, self._executor, self._process = operators, store, executor, process
        self._bodies = BodyReader(_BODY_BYTES, _BODY_S)
        self._limit = RateLimiter(_RATE, _BURST, monotonic, "simulated steps", "operator")

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        described = operation(
            "A step of the machine's model with another gap, dead zone or gains",
            {200: ("The simulated step, decimated for a screen, and its place in a stability map; SI units.", JSON)},
            (SERVO,),
            body="gap, and optionally tolerance or k_dz, gains, step, duration; SI units.",
            body_type=JSON,
            errors=(400, 401, 403, 413, 429, 503),
        )
        residual = operation(
            "Residual of a window's fit, how white it is, and whether the machine came to rest",
            {200: ("Computed anew from the stored window and its estimate; SI units.", JSON)},
            (SERVO, BOOT, SEQUENCE),
            errors=(*QUERY_ERRORS, 429),
        )
        return [
            HttpRoute("POST", SERVO_PATH + "/what-if", self._post, described),
            HttpRoute("GET", WINDOW_PATH + "/residual", self._get_residual, residual),
        ]

    async def _post(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        self._limit.take(self._operators.check(request))
        body = await self._bodies.read(request.content_length, request.receive)
        return _fresh(await self._process.answer(servo, body))

    async def _get_residual(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        self._limit.take(self._operators.check(request))
        stored = await stored_window(self._operators, self._store, self._executor, request)
        key = request.path["boot"], int(request.path["sequence"])
        fit = await store_query(self._executor, partial(_stored_fit, self._store, servo, key, stored))
        return _fresh(await self._process.answer(servo, msgspec.msgpack.encode(fit), QuestionKind.RESIDUAL))


def _stored_fit(store: Store, servo: str, key: tuple[str, int], stored: StoredMessage) -> dict[str, object]:
    """A window with its estimate and context; raises RequestRejected where it has none."""
    try:
        window = decompress(stored.body, stored.encoding, MAX_BYTES)
    except InvalidMessage as error:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"the stored window cannot be read: {error}", 404) from None
    evidence = [each for trace in store.audit(servo, window=key) for each in trace.evidence if each.kind == "estimate"]
    if not evidence:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, _NOT_ESTIMATED, 404)
    context = store.contexts([evidence[-1].context]).get(evidence[-1].context, "")
    return {"window": window, "body": evidence[-1].body, "context": context}


def _fresh(answer: bytes) -> HttpResponse:
    return HttpResponse(200, answer, JSON, {"cache-control": "no-store", "x-content-type-options": "nosniff"})
