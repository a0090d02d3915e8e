"""HTTP API of the series as Parquet files, beside the CSV files of the dashboard's other routes."""

from __future__ import annotations

from functools import partial

import msgspec

from servotwin.dashboard.series import machine_of, machine_series
from servotwin.dashboard.window_view import window_columns
from servotwin.store.store import Store
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_dashboard import decoded_window
from servotwin.twin_service.http_edge import SERVO_PATH, WINDOW_PATH
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse
from servotwin.twin_service.http_operator import MAX_ROWS, admitted_servo, limit_of, store_query, stored_window
from servotwin.twin_service.openapi import (
    BOOT,
    INTEGER,
    PARQUET,
    QUERY_ERRORS,
    SEQUENCE,
    SERVO,
    operation,
    parameter,
)
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.what_if_process import QuestionKind, WhatIfProcess


class ParquetApi:
    """Routes of Parquet files, which a process of its own writes: pyarrow is large, and may be missing.

    Parameters
    ----------
    operators : OperatorAccess
    store, executor : Store, StoreExecutor
    process : WhatIfProcess
    """

    def __init__(
        self, operators: OperatorAccess, store: Store, executor: StoreExecutor, process: WhatIfProcess
    ) -> None:
        self._operators, self._store, self._executor, self._process = operators, store, executor, process

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        limit = parameter("limit", {**INTEGER, "maximum": MAX_ROWS}, "Largest number of windows.")
        before = parameter("before", INTEGER, "Only windows with lower ids: the next page.")
        file = {200: ("Parquet; without the extra parquet the answer says so.", PARQUET)}
        errors = (*QUERY_ERRORS, 429)
        gaps = operation("Columns of the gap over the windows as a file", file, (SERVO, limit, before), errors=errors)
        channels = operation("Every sample of a window as a file", file, (SERVO, BOOT, SEQUENCE), errors=errors)
        return [
            HttpRoute("GET", SERVO_PATH + "/gaps.parquet", self._get_gaps, gaps),
            HttpRoute("GET", WINDOW_PATH + "/channels.parquet", self._get_channels, channels),
        ]

    async def _get_gaps(self, request: HttpRequest) -> HttpResponse:
        servo = admitted_servo(self._operators, request)
        before = request.integer("before", 0) or None
        read = partial(machine_series, servo=servo, limit=limit_of(request), before=before)
        found = await store_query(self._executor, partial(self._store.reading, read, servo))
        return await self._file(servo, found["windows"], f"{servo}-gaps.parquet")

    async def _get_channels(self, request: HttpRequest) -> HttpResponse:
        stored = await stored_window(self._operators, self._store, self._executor, request)
        servo, boot, sequence = (request.path[key] for key in ("servo", "boot", "sequence"))
        machine = await store_query(
            self._executor, partial(self._store.reading, partial(machine_of, servo=servo), servo)
        )
        columns = await self._executor.run(lambda: window_columns(decoded_window(stored), machine))
        return await self._file(servo, columns, f"{servo}-{boot}-{sequence}.parquet")

    async def _file(self, servo: str, columns: object, name: str) -> HttpResponse:
        packed = await self._executor.run(partial(msgspec.msgpack.encode, columns))
        body = await self._process.answer(servo, packed, QuestionKind.PARQUET)
        headers = {"content-disposition": f'attachment; filename="{name}"', "x-content-type-options": "nosniff"}
        return HttpResponse(200, body, PARQUET, headers)
