"""HTTP API of the operators: servos, windows, the evidence chain; health and metrics for monitoring."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

import msgspec

from servotwin.messages import NAME_PATTERN, Refusal
from servotwin.runtime.prometheus import CONTENT_TYPE
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import Backlog, StoredEvidence, StoredMessage, WindowTrace
from servotwin.store.store import Store
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_edge import SERVO_PATH, WINDOW_PATH
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse, json_response
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.openapi import (
    BOOT,
    INTEGER,
    JSON,
    MSGPACK,
    QUERY_ERRORS,
    SECONDS,
    SEQUENCE,
    SERVO,
    TEXT,
    operation,
    parameter,
)
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.store_executor import StoreExecutor, unavailable

MAX_ROWS = 1000
_Result = TypeVar("_Result")
_BACKLOG_S, _PATIENCE_S = 0.5, 5.0
"""s for which a backlog that was read is served again; s that a request for health waits for the store."""
Health = Callable[[Backlog | None], dict[str, Any]]
"""Returns the health of each part of the service, "ok" for all of them, and "degraded"; None: the store is away."""


class OperatorApi:
    """Routes that only read.

    Parameters
    ----------
    operators : OperatorAccess
    store : Store
    executor, readers : StoreExecutor
        For the backlog, which monitoring asks for; for all else, which may take long.
    health : callable
    metrics : Metrics
    wall : callable
        s since the epoch.
    """

    def __init__(
        self,
        operators: OperatorAccess,
        store: Store,
        executor: StoreExecutor,
        readers: StoreExecutor,
        health: Health,
        metrics: Metrics,
        wall: Callable[[], float],
    ) -> None:
        self._operators, self._store, self._executor, self._readers = operators, store, executor, readers
        self._health, self._metrics, self._wall = health, metrics, wall
        self._reading: asyncio.Future[Backlog] | None = None
        self._backlog: tuple[float, Backlog | None] = -math.inf, None
        metrics.add_gauge("servotwin_waiting", "Messages and verifications not yet processed.", self._counts, "kind")
        metrics.add_gauge("servotwin_waiting_seconds", "Age of the oldest message not yet processed.", self._age)
        lag = "Longest time for which new messages of a servo have waited for its turn, or a servo for an estimate."
        metrics.add_gauge("servotwin_lag_seconds", lag, self._lag)

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        limit = parameter("limit", {**INTEGER, "maximum": MAX_ROWS}, "Largest number of rows.")
        servos = operation(
            "Summaries of all servos",
            {200: ("By name.", JSON)},
            parameters=(parameter("after", {"type": "string"}, "Only names after this one."), limit),
            errors=QUERY_ERRORS,
        )
        servo = operation("Summary of one servo", {200: ("Its present state.", JSON)}, (SERVO,), errors=QUERY_ERRORS)
        audit = operation(
            "The evidence chain: window, estimate, version, receipt, effect",
            {200: ("Newest window first.", JSON)},
            parameters=(
                SERVO,
                limit,
                parameter("since", SECONDS, "Only windows received then or later, s since the epoch."),
                parameter("before", INTEGER, "Only windows with lower ids: the next page."),
                parameter("updates", {**INTEGER, "maximum": 1}, "1: only windows that led to an update."),
            ),
            errors=QUERY_ERRORS,
        )
        events = operation(
            "Evidence that belongs to no window: starts of the edge, fallbacks, answers, faults of the twin itself",
            {200: ("Newest first.", JSON)},
            parameters=(
                SERVO,
                limit,
                parameter("since", SECONDS, "Only evidence from then or later, s since the epoch."),
            ),
            errors=QUERY_ERRORS,
        )
        window = operation(
            "A window as it came", {200: ("window/1.", MSGPACK)}, (SERVO, BOOT, SEQUENCE), errors=QUERY_ERRORS
        )
        healthy = {200: ("All is well.", JSON), 503: ("A part is not healthy; the body names it.", JSON)}
        return [
            HttpRoute("GET", "/v1/servos", self._get_servos, servos),
            HttpRoute("GET", SERVO_PATH, self._get_servo, servo),
            HttpRoute("GET", SERVO_PATH + "/audit", self._get_audit, audit),
            HttpRoute("GET", SERVO_PATH + "/events", self._get_events, events),
            HttpRoute("GET", WINDOW_PATH, self._get_window, window),
            HttpRoute("GET", "/healthz", self._get_health, operation("Health of the service", healthy)),
            HttpRoute(
                "GET",
                "/metrics",
                self._get_metrics,
                operation("Metrics for Prometheus", {200: ("Text format 0.0.4.", TEXT)}),
            ),
        ]

    async def _get_servos(self, request: HttpRequest) -> HttpResponse:
        self._operators.check(request)
        after, limit = request.argument("after") or "", limit_of(request)
        if after and not re.match(NAME_PATTERN, after):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, "after: give the name of a servo")
        summaries = await self._query(partial(self._store.servos, after, limit))
        return json_response([summary._asdict() for summary in summaries])

    async def _get_servo(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        summary = await self._query(partial(self._store.servo, servo))
        if summary is None:
            raise RequestRejected(Refusal.UNKNOWN_SERVO, f"servo {servo!r} has never sent a message")
        return json_response(summary._asdict())

    async def _get_audit(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        since = request.seconds("since", 0.0) or None
        before = request.integer("before", 0) or None
        updates = bool(request.integer("updates", 0))
        traces = await self._query(partial(self._store.audit, servo, since, limit_of(request), None, before, updates))
        return json_response([trace_as_json(trace) for trace in traces])

    async def _get_events(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        since = request.seconds("since", 0.0)
        events = await self._query(partial(self._store.events, servo, since, limit_of(request)))
        return json_response([evidence_as_json(event) for event in events])

    async def _get_window(self, request: HttpRequest) -> HttpResponse:
        """The stored bytes of a window, with their compression as content-encoding."""
        window = await stored_window(self._operators, self._store, self._readers, request)
        headers = {"content-encoding": window.encoding} if window.encoding else {}
        return HttpResponse(200, window.body, MSGPACK, headers)

    async def _get_health(self, _request: HttpRequest) -> HttpResponse:
        """Health and backlog: 200, or 503."""
        try:
            backlog = await self._read_backlog()
            health = {**self._health(backlog), "waiting": backlog._asdict()}
        except StoreUnavailable:
            health = {**self._health(None), "ok": False, "store": False}
        return json_response(health, 200 if health["ok"] else 503)

    async def _get_metrics(self, _request: HttpRequest) -> HttpResponse:
        with suppress(StoreUnavailable):  # the gauges then show the last backlog
            await self._read_backlog()
        return HttpResponse(200, self._metrics.text().encode(), CONTENT_TYPE)

    def _counts(self) -> Mapping[str, float]:
        backlog = self._backlog[1]
        return {} if backlog is None else {"messages": backlog.messages, "verifications": backlog.verifications}

    def _age(self) -> float:
        backlog = self._backlog[1]
        return math.nan if backlog is None else backlog.age

    def _lag(self) -> float:
        backlog = self._backlog[1]
        return math.nan if backlog is None else backlog.lag

    async def _read_backlog(self) -> Backlog:
        """Backlog, read from the store at most every 0.5 s: requests for it need no token and have no rate limit.

        Raises
        ------
        StoreUnavailable
            It cannot be read, or not in time: whoever asks for health needs an answer.
        """
        at, backlog = self._backlog
        if backlog is not None and 0.0 <= self._wall() - at < _BACKLOG_S:
            return backlog
        if self._reading is None or self._reading.done():
            self._reading = asyncio.ensure_future(self._executor.run(lambda: self._store.backlog(self._wall())))
            self._reading.add_done_callback(self._note_backlog)
        # Not cancelled when the time is over: it goes on to the next request's answer.
        await asyncio.wait({self._reading}, timeout=_PATIENCE_S)
        if not self._reading.done():
            raise StoreUnavailable("the store does not answer")
        return self._reading.result()

    def _note_backlog(self, reading: asyncio.Future[Backlog]) -> None:
        if not reading.cancelled() and reading.exception() is None:
            self._backlog = self._wall(), reading.result()

    async def _query(self, call: Callable[[], Any]) -> Any:
        return await store_query(self._readers, call)


def admitted_servo(operators: OperatorAccess, request: HttpRequest) -> str:
    """Name of the servo in the path, for an operator; raises RequestRejected."""
    operators.check(request)
    servo = request.path["servo"]
    if not re.match(NAME_PATTERN, servo):
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, "servo: give 1 to 64 letters, digits, . _ or -")
    return servo


async def stored_window(
    operators: OperatorAccess, store: Store, executor: StoreExecutor, request: HttpRequest
) -> StoredMessage:
    """The window in the path with its body, for an operator; raises RequestRejected."""
    servo = admitted_servo(operators, request)
    boot, sequence = request.path["boot"], _sequence(request.path["sequence"])
    if not re.match(NAME_PATTERN, boot):
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, "boot: give 1 to 64 letters, digits, . _ or -")
    window = await store_query(executor, partial(store.window, servo, boot, sequence))
    if window is None or not window.body:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, "the body of this window is not stored", 404)
    return window


async def store_query(executor: StoreExecutor, call: Callable[[], _Result]) -> _Result:
    """Result of a call that reads the store; raises RequestRejected where it cannot be read."""
    try:
        return await executor.run(call)
    except StoreUnavailable as error:
        raise unavailable(error, "the store cannot be read now") from None


def trace_as_json(trace: WindowTrace) -> dict[str, Any]:
    """A window's evidence chain for JSON, MessagePack bodies decoded."""
    return {
        "window": trace.window._asdict(),
        "evidence": [evidence_as_json(record) for record in trace.evidence],
        "steps": [
            {
                "update": evidence_as_json(step.update),
                "answers": [evidence_as_json(record) for record in step.answers],
                "effect": None
                if step.effect is None
                else {
                    "window": step.effect.window._asdict(),
                    "before": None if step.effect.before is None else evidence_as_json(step.effect.before),
                    "after": evidence_as_json(step.effect.after),
                },
            }
            for step in trace.steps
        ],
    }


def evidence_as_json(record: StoredEvidence) -> dict[str, Any]:
    """A piece of evidence for JSON, its body decoded; null where it cannot be. `received`: where a letter led to it."""
    try:
        body = msgspec.msgpack.decode(record.body)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        body = None
    row = {**record._asdict(), "body": body}
    if record.received is None:
        del row["received"]
    return row


def limit_of(request: HttpRequest) -> int:
    """Argument `limit`: rows at most."""
    return min(request.integer("limit", 100) or 1, MAX_ROWS)


def _sequence(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 16):
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, "sequence: give a whole number of at most 16 digits")
    return int(text)
