"""Refused requests: counted, logged, and slowed down where they come in a loop."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Any

from servotwin.messages import Refusal
from servotwin.twin_service.limits import RateLimiter
from servotwin.twin_service.monitoring import Metrics, RefusalLog

log = logging.getLogger(__name__)

_PER_S, _AT_ONCE, _SLOW_S = 10.0, 100.0, 1.0
"""Refusals per s that are answered at once, after so many together; s that any other one takes: whoever repeats refused
requests, with a token or without, would slow all others."""
_ALL = "everybody"


class Refusals:
    """Refusals of one twin, from whomever.

    Parameters
    ----------
    metrics : Metrics
    wrong_token : callable
        Called with the servo in the path of a request whose token is refused; empty: the path names none.
    monotonic : callable
        s.
    """

    def __init__(
        self,
        metrics: Metrics,
        wrong_token: Callable[[str], None] = lambda _servo: None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._metrics, self._wrong_token = metrics, wrong_token
        self._lines, self._pace = RefusalLog(log, monotonic), RateLimiter(_PER_S, _AT_ONCE, monotonic)

    def log(self, code: Refusal, servo: str, shown: bool, **about: Any) -> None:
        """Log a refusal; `shown`: the request had a token. A page without a session has none, and is no attempt."""
        self._lines.write(code.value, servo=servo, **about)
        if code is Refusal.BAD_TOKEN and shown:
            self._wrong_token(servo)

    async def count(self, code: Refusal) -> None:
        """Count a refusal, and hold it back where they come in a loop."""
        self._metrics.rejected.add(code.value)
        if not self._pace.admits(_ALL):
            await asyncio.sleep(_SLOW_S)
