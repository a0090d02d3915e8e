"""HTTP API of the dashboard: its page, sessions of browsers, the fleet with its changes, and series of one machine."""

from __future__ import annotations

import re
from functools import partial
from typing import Any

import msgspec
import sqlalchemy as sa

from servotwin.dashboard.assets import INDEX, REPORT_SECURITY, SECURITY, Asset, assets
from servotwin.dashboard.machine_facts import MachineFacts
from servotwin.dashboard.machine_metrics import machine_metrics
from servotwin.dashboard.rest import at_rest
from servotwin.dashboard.series import machine_of, machine_series, table_csv
from servotwin.dashboard.window_view import MAX_POINTS, channel_series, sample_range, window_columns
from servotwin.errors import InvalidInput
from servotwin.messages import MAX_BYTES, NAME_PATTERN, Refusal, WindowMessage, decode
from servotwin.messages.checks import InvalidMessage
from servotwin.messages.codec import decompress
from servotwin.runtime.prometheus import CONTENT_TYPE
from servotwin.store import overview
from servotwin.store.records import StoredMessage
from servotwin.store.store import Store
from servotwin.twin_service.fleet_feed import FleetFeed, position_of
from servotwin.twin_service.fleet_reader import FleetReader
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_edge import SERVO_PATH, WINDOW_PATH
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse, HttpStream, json_response
from servotwin.twin_service.http_operator import MAX_ROWS, admitted_servo, limit_of, store_query, stored_window
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.openapi import (
    BOOT,
    CSV,
    EVENTS,
    HTML,
    INTEGER,
    JSON,
    QUERY_ERRORS,
    SECONDS,
    SEQUENCE,
    SERVO,
    TEXT,
    operation,
    parameter,
)
from servotwin.twin_service.reports import report_of
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.store_executor import StoreExecutor

_NAME = re.compile(NAME_PATTERN)
_LOGIN_BYTES, _LOGIN_S = 4096, 10.0
_SPARK_SERVOS, _SPARK_WINDOWS = 64, 48
"""Servos in one request for short histories, and windows of each."""


class Login(msgspec.Struct):
    """Body of a login."""

    token: str


class DashboardApi:
    """Routes of the dashboard: they read, and a login writes nothing but a cookie.

    Parameters
    ----------
    operators : OperatorAccess
    store, executor : Store, StoreExecutor
    reader, feed : FleetReader, FleetFeed
    machine_metrics : bool
        Serve metrics of each machine.
    """

    def __init__(
        self,
        operators: OperatorAccess,
        store: Store,
        executor: StoreExecutor,
        reader: FleetReader,
        feed: FleetFeed,
        machine_metrics: bool = False,
    ) -> None:
        self._machine_metrics = machine_metrics
        self._operators, self._store, self._executor = operators, store, executor
        self._reader, self._feed = reader, feed
        self._bodies = BodyReader(_LOGIN_BYTES, _LOGIN_S)

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        return [*self._page_routes(), *self._fleet_routes(), *self._servo_routes()]

    def _page_routes(self) -> list[HttpRoute]:
        page = operation("The dashboard", {200: ("A page.", HTML)})
        file = operation(
            "A file of the dashboard",
            {200: ("The file.", None), 304: ("It has not changed.", None)},
            (parameter("file", {"type": "string"}, "Its name.", "path"),),
            errors=(404,),
        )
        known = operation(
            "Session of this browser", {200: ("tokens: they are needed; admitted: this browser may read.", JSON)}
        )
        login = operation(
            "Begin a session: the answer sets a cookie",
            {204: ("It has begun.", None)},
            body="token: an operator's.",
            body_type=JSON,
            errors=(400, 401, 403, 413, 503),
        )
        logout = operation("End the session of this browser", {204: ("It has ended.", None)}, errors=(403,))
        return [
            HttpRoute("GET", "/", self._get_page, page),
            HttpRoute("GET", "/static/{file}", self._get_file, file),
            HttpRoute("GET", "/v1/session", self._get_session, known),
            HttpRoute("POST", "/v1/session", self._post_session, login),
            HttpRoute("DELETE", "/v1/session", self._delete_session, logout),
        ]

    def _fleet_routes(self) -> list[HttpRoute]:
        limit = parameter("limit", {**INTEGER, "maximum": MAX_ROWS}, "Largest number of rows.")
        fleet = operation(
            "Rows of the fleet: gap with interval, wear, time to the limit, version, last window, link, alarms",
            {200: ("rows by name; position: for `after` of the events; now: s since the epoch.", JSON)},
            (parameter("after", {"type": "string"}, "Only names after this one."), limit),
            errors=QUERY_ERRORS,
        )
        metrics = operation(
            "Metrics of each machine for Prometheus, where machine_metrics is set",
            {200: ("Text format 0.0.4.", TEXT)},
            errors=QUERY_ERRORS,
        )
        events = operation(
            "Changes of the fleet as server-sent events: links, rows, reload, trouble, ended",
            {200: ("Events without end; the id of each is the position after it.", EVENTS)},
            (
                parameter("after", {"type": "string"}, "Position from which on changes are sent."),
                parameter("last-event-id", {"type": "string"}, "The same, of a stream that broke.", "header"),
            ),
            errors=(401, 403, 429, 503),
        )
        histories = operation(
            f"Gaps of the last {_SPARK_WINDOWS} windows of some servos",
            {200: ("Gaps in rad by servo, oldest first; null: unknown.", JSON)},
            (parameter("servos", {"type": "string"}, f"Names with commas between them, {_SPARK_SERVOS} at most."),),
            errors=QUERY_ERRORS,
        )
        return [
            HttpRoute("GET", "/v1/fleet", self._get_fleet, fleet),
            *([HttpRoute("GET", "/metrics/machines", self._get_metrics, metrics)] if self._machine_metrics else []),
            HttpRoute("GET", "/v1/fleet/events", self._get_events, events),
            HttpRoute("GET", "/v1/fleet/histories", self._get_histories, histories),
        ]

    def _servo_routes(self) -> list[HttpRoute]:
        limit = parameter("limit", {**INTEGER, "maximum": MAX_ROWS}, "Largest number of windows.")
        paged = (SERVO, limit, parameter("before", INTEGER, "Only windows with lower ids: the next page."))
        gaps = operation(
            "Gap over the windows: estimate, interval, trend, version, error; versions and fallbacks",
            {200: ("Columns, oldest window first; rad, and m or rad.", JSON)},
            paged,
            errors=QUERY_ERRORS,
        )
        gaps_csv = operation("The same columns as a file", {200: ("CSV.", CSV)}, paged, errors=QUERY_ERRORS)
        window = (SERVO, BOOT, SEQUENCE)
        channels = operation(
            "Channels of a window for a screen: least and greatest sample of each column",
            {200: ("Every sample, where there are at most four a column; rest: a word on the window's end.", JSON)},
            (
                *window,
                parameter("from", SECONDS, "Only samples from then on, s after the first."),
                parameter("to", SECONDS, "Only samples until then."),
                parameter("points", {**INTEGER, "maximum": MAX_POINTS}, "Columns; 1000 where absent."),
            ),
            errors=QUERY_ERRORS,
        )
        channels_csv = operation("Every sample of a window", {200: ("CSV.", CSV)}, window, errors=QUERY_ERRORS)
        report = operation(
            "Report of a machine, to mail",
            {200: ("One HTML file that needs no other.", HTML)},
            (SERVO,),
            errors=QUERY_ERRORS,
        )
        return [
            HttpRoute("GET", SERVO_PATH + "/report.html", self._get_report, report),
            HttpRoute("GET", SERVO_PATH + "/gaps", self._get_gaps, gaps),
            HttpRoute("GET", SERVO_PATH + "/gaps.csv", self._get_gaps_csv, gaps_csv),
            HttpRoute("GET", WINDOW_PATH + "/channels", self._get_channels, channels),
            HttpRoute("GET", WINDOW_PATH + "/channels.csv", self._get_channels_csv, channels_csv),
        ]

    async def _get_page(self, request: HttpRequest) -> HttpResponse:
        return _file(assets()[INDEX], request)

    async def _get_file(self, request: HttpRequest) -> HttpResponse:
        asset = assets().get(request.path["file"])
        if asset is None:
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, "the dashboard has no such file", 404)
        return _file(asset, request)

    async def _get_session(self, request: HttpRequest) -> HttpResponse:
        try:
            self._operators.check(request)
            admitted = True
        except RequestRejected:
            admitted = False
        return _fresh({"tokens": not self._operators.open, "admitted": admitted})

    async def _post_session(self, request: HttpRequest) -> HttpResponse:
        body = await self._bodies.read(request.content_length, request.receive)
        try:
            login = msgspec.json.decode(body, type=Login)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, 'give {"token": "..."}') from None
        cookie = self._operators.session_cookie(login.token.strip().encode("utf-8", "replace"))
        return HttpResponse(204, headers={"set-cookie": cookie})

    async def _delete_session(self, _request: HttpRequest) -> HttpResponse:
        return HttpResponse(204, headers={"set-cookie": self._operators.ended_cookie()})

    async def _get_fleet(self, request: HttpRequest) -> HttpResponse:
        self._operators.check(request)
        after = request.argument("after") or ""
        if after and not _NAME.match(after):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, "after: give the name of a servo")
        page = await store_query(self._executor, partial(self._reader.page, after, limit_of(request)))
        return _fresh({"rows": page.rows, "position": page.position.text, "now": page.now})

    async def _get_metrics(self, request: HttpRequest) -> HttpResponse:
        self._operators.check(request)
        text = await store_query(self._executor, lambda: machine_metrics(self._reader.all()))
        return HttpResponse(200, text.encode(), CONTENT_TYPE)

    async def _get_events(self, request: HttpRequest) -> HttpStream:
        self._operators.check(request)
        self._feed.admit()
        last = (request.header(b"last-event-id") or b"").decode("latin-1")
        after = position_of(last) or position_of(request.argument("after"))
        events = self._feed.watch(after, partial(self._operators.check, request))
        return HttpStream(events, EVENTS, request, self._feed.closing)

    async def _get_histories(self, request: HttpRequest) -> HttpResponse:
        self._operators.check(request)
        names = [name for name in (request.argument("servos") or "").split(",") if name]
        if len(names) > _SPARK_SERVOS or not all(_NAME.match(name) for name in names):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"servos: give up to {_SPARK_SERVOS} names of servos")

        def read(connection: sa.Connection) -> dict[str, list[float | None]]:
            return {name: _history(connection, name) for name in self._store.sound(names)}

        return _fresh(await store_query(self._executor, partial(self._store.reading, read)))

    async def _get_gaps(self, request: HttpRequest) -> HttpResponse:
        servo, limit, before = self._page_of(request)
        return _fresh(await store_query(self._executor, partial(self._gaps, servo, limit, before)))

    async def _get_gaps_csv(self, request: HttpRequest) -> HttpResponse:
        servo, limit, before = self._page_of(request)
        found = await store_query(self._executor, partial(self._gaps, servo, limit, before))
        text = await self._executor.run(partial(table_csv, found["windows"]))
        return _csv(text, f"{servo}-gaps.csv")

    def _page_of(self, request: HttpRequest) -> tuple[str, int, int | None]:
        servo = admitted_servo(self._operators, request)
        return servo, limit_of(request), request.integer("before", 0) or None

    def _gaps(self, servo: str, limit: int, before: int | None) -> dict[str, Any]:
        return self._store.reading(lambda connection: machine_series(connection, servo, limit, before), servo)

    async def _get_report(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        text = await store_query(self._executor, partial(report_of, self._store, self._reader, servo))
        if text is None:
            raise RequestRejected(Refusal.UNKNOWN_SERVO, f"servo {servo!r} has never sent a message")
        attachment = {"content-disposition": f'attachment; filename="{servo}.html"'}
        return HttpResponse(200, text.encode(), HTML, {**REPORT_SECURITY, **attachment, "cache-control": "no-store"})

    async def _get_channels(self, request: HttpRequest) -> HttpResponse:
        stored = await stored_window(self._operators, self._store, self._executor, request)
        begin, end = (request.seconds(key, -1.0) for key in ("from", "to"))
        points = min(request.integer("points", 1000) or 1, MAX_POINTS)
        part, machine = (None if begin < 0.0 else begin, None if end < 0.0 else end), await self._machine(request)
        return _fresh(await self._executor.run(partial(_channels, stored, part, points, machine)))

    async def _get_channels_csv(self, request: HttpRequest) -> HttpResponse:
        stored = await stored_window(self._operators, self._store, self._executor, request)
        machine = await self._machine(request)
        text = await self._executor.run(lambda: table_csv(window_columns(decoded_window(stored), machine)))
        servo, boot, sequence = (request.path[key] for key in ("servo", "boot", "sequence"))
        return _csv(text, f"{servo}-{boot}-{sequence}.csv")

    async def _machine(self, request: HttpRequest) -> MachineFacts:
        read = partial(machine_of, servo=(servo := request.path["servo"]))
        return await store_query(self._executor, partial(self._store.reading, read, servo))


def _channels(
    stored: StoredMessage, part: tuple[float | None, float | None], points: int, machine: MachineFacts
) -> dict[str, Any]:
    window = decoded_window(stored)
    try:
        selected = sample_range(window, *part)
    except InvalidInput as error:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, str(error)) from None
    return {
        "boot": window.boot,
        "sequence": window.sequence,
        "start": window.start,
        "rate": window.rate,
        "samples": window.samples,
        "reason": window.reason,
        "version": window.parameter_version,
        "channels": channel_series(window, selected, points, machine),
        "rest": at_rest(window) if part == (None, None) else None,
    }


def decoded_window(stored: StoredMessage) -> WindowMessage:
    """Decode a stored window; raises RequestRejected where it cannot be read."""
    try:
        window = decode(decompress(stored.body, stored.encoding, MAX_BYTES))
    except InvalidMessage as error:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, f"the stored window cannot be read: {error}", 404) from None
    if not isinstance(window, WindowMessage):
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, "the stored message is no window", 404)
    return window


def _history(connection: sa.Connection, servo: str) -> list[float | None]:
    found = overview.gaps(connection, servo, _SPARK_WINDOWS, bodies=False)
    return [
        next((one.gap for one in reversed(each.evidence) if one.kind in ("glance", "estimate")), None) for each in found
    ]


def _file(asset: Asset, request: HttpRequest) -> HttpResponse:
    headers = {**SECURITY, "etag": asset.tag, "cache-control": "no-cache", "vary": "accept-encoding"}
    if (request.header(b"if-none-match") or b"").decode("latin-1") == asset.tag:
        return HttpResponse(304, headers=headers)
    if b"gzip" in (request.header(b"accept-encoding") or b""):
        return HttpResponse(200, asset.compressed, asset.content_type, {**headers, "content-encoding": "gzip"})
    return HttpResponse(200, asset.body, asset.content_type, headers)


def _fresh(value: object) -> HttpResponse:
    """Response in JSON that nobody keeps."""
    return json_response(value, headers={"cache-control": "no-store", "x-content-type-options": "nosniff"})


def _csv(text: str, name: str) -> HttpResponse:
    headers = {"content-disposition": f'attachment; filename="{name}"', "x-content-type-options": "nosniff"}
    return HttpResponse(200, text.encode(), CSV, headers)
