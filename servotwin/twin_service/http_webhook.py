"""HTTP API of the webhook: where alarms are posted to, and a test of it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial

from servotwin.errors import InvalidInput
from servotwin.messages import Refusal
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse, json_response
from servotwin.twin_service.limits import RateLimiter, RequestRejected
from servotwin.twin_service.openapi import JSON, operation
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.webhook import AlarmPost, WebhookAway, WebhookConfig, WebhookRefused, alarm_post, send_post

_RATE, _BURST = 0.1, 3.0
"""Tests of one engineer: per s, and at once."""
_FRESH = {"cache-control": "no-store", "x-content-type-options": "nosniff"}
_NONE = "the twin's file has no [service.webhook], so that no alarm is posted"


class WebhookApi:
    """Routes of the webhook: operators see its host, engineers test it.

    Parameters
    ----------
    operators : OperatorAccess
    config : WebhookConfig or None
    monotonic : callable
        s.
    send : callable
        `send_post`.
    """

    def __init__(
        self,
        operators: OperatorAccess,
        config: WebhookConfig | None,
        monotonic: Callable[[], float],
        send: Callable[[WebhookConfig, AlarmPost], int] = send_post,
    ) -> None:
        self._operators, self._config, self._send = operators, config, send
        self._limit = RateLimiter(_RATE, _BURST, monotonic, "tests of the webhook", "engineer")

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        shown = operation(
            "Host to which alarms are posted",
            {200: ("host, null: none; may_test: this reader may test it.", JSON)},
            errors=(401, 403),
        )
        test = operation(
            "Post a test alarm, once",
            {200: ("It was taken: host, and status that it answered.", JSON)},
            errors=(401, 403, 404, 429, 503),
        )
        return [
            HttpRoute("GET", "/v1/webhook", self._get, shown),
            HttpRoute("POST", "/v1/webhook/test", self._post, test),
        ]

    async def _get(self, request: HttpRequest) -> HttpResponse:
        name = self._operators.check(request)
        host = None if self._config is None else self._config.host
        return json_response({"host": host, "may_test": bool(host) and self._operators.may_act(name)}, headers=_FRESH)

    async def _post(self, request: HttpRequest) -> HttpResponse:
        who = self._operators.check_engineer(request)
        if self._config is None:
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, _NONE, 404)
        self._limit.take(who)
        post = alarm_post("test", "alarm", f"this is a test of the webhook by {who}", time.time())
        try:
            status = await asyncio.to_thread(partial(self._send, self._config, post))
        except (WebhookAway, WebhookRefused, InvalidInput) as error:
            raise RequestRejected(Refusal.UNAVAILABLE, f"the webhook did not take the test: {error}") from None
        return json_response({"host": self._config.host, "status": status}, headers=_FRESH)
