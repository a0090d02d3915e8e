"""Alarms by webhook: each one is posted as JSON, and again until it is taken.

What waits is in memory only. After a restart the alarms before it are in the store and on the dashboard, but are not
posted any more.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict, deque
from collections.abc import Callable
from enum import StrEnum
from functools import partial

from servotwin.errors import InvalidInput
from servotwin.runtime.retry import Backoff, Retry
from servotwin.store.records import Lease, WorkResult
from servotwin.twin_service.evidence_lines import ALARMS, log_kind
from servotwin.twin_service.monitoring import Counter
from servotwin.twin_service.webhook import (
    AlarmPost,
    WebhookAway,
    WebhookConfig,
    WebhookRefused,
    alarm_post,
    send_post,
)

log = logging.getLogger(__name__)

_OLDEST_S = 86400.0
"""s after which an alarm that was not taken is dropped."""
_WAITING, _KNOWN = 1000, 10_000
"""Alarms that wait, and alarms that are remembered so as not to be repeated."""
_RETRY = Retry(2.0, 2.0, 300.0)
OF_ALL = "twin"
"""Stands for a machine's name in alarms of the twin itself."""


class PostOutcome(StrEnum):
    """End of a post: taken; refused for good; lost, because it was too old or too many waited."""

    TAKEN = "taken"
    REFUSED = "refused"
    DROPPED = "dropped"


class AlarmWebhook:
    """Alarms that wait to be posted, in order.

    Parameters
    ----------
    config : WebhookConfig
    counter : Counter
        Of outcomes.
    wall, monotonic : callable
        s.
    send : callable
        `send_post`.
    """

    def __init__(
        self,
        config: WebhookConfig,
        counter: Counter,
        wall: Callable[[], float],
        monotonic: Callable[[], float],
        send: Callable[[WebhookConfig, AlarmPost], int] = send_post,
    ) -> None:
        self._config, self._counter, self._wall, self._monotonic = config, counter, wall, monotonic
        self._send = send
        self._waiting: deque[tuple[float, AlarmPost]] = deque()
        self._posted: OrderedDict[tuple[str, str], float] = OrderedDict()
        self._some = asyncio.Event()

    @property
    def waiting(self) -> int:
        """Number of alarms that wait."""
        return len(self._waiting)

    def note(self, lease: Lease, result: WorkResult) -> None:
        """Queue the alarms of a lease's result, once it is committed."""
        received = {message.id: message.received for message in lease.messages}
        for record in result.evidence:
            kind = log_kind(record)
            if kind in ALARMS:
                came = received.get(record.message)
                self._queue(alarm_post(result.servo, kind, record.status, self._wall(), record.version, came))

    def announce(self, kind: str, sentence: str, servo: str = OF_ALL) -> None:
        """Queue an alarm of the twin itself, which concerns one machine or all."""
        self._queue(alarm_post(servo, kind, sentence, self._wall()))

    async def run(self) -> None:
        """Post what waits."""
        while True:
            await self._some.wait()
            self._some.clear()
            while self._waiting:
                await self._post_first()

    def _queue(self, post: AlarmPost) -> None:
        now, known = self._monotonic(), (post.servo, post.text)
        if now - self._posted.get(known, -self._config.repeat - 1.0) <= self._config.repeat:
            return
        self._posted[known] = now
        self._posted.move_to_end(known)
        if len(self._posted) > _KNOWN:
            self._posted.popitem(last=False)
        if len(self._waiting) >= _WAITING:
            self._waiting.popleft()
            self._end(PostOutcome.DROPPED)
        self._waiting.append((now, post))
        self._some.set()

    async def _post_first(self) -> None:
        """Post the first one until it is taken, refused or too old."""
        backoff, first = Backoff(_RETRY), self._waiting[0]
        queued, post = first
        while True:
            try:
                await asyncio.to_thread(partial(self._send, self._config, post))
                outcome = PostOutcome.TAKEN
                if backoff.failures:
                    log.info("webhook answers again")
            except WebhookRefused as refused:
                outcome = PostOutcome.REFUSED
                log.error("webhook refused an alarm", extra={"servo": post.servo, "why": str(refused)})
            except (WebhookAway, InvalidInput) as away:
                if not backoff.failures:
                    log.warning("webhook away", extra={"why": str(away)})
                await asyncio.sleep(backoff.failed())
                if self._monotonic() - queued < _OLDEST_S and self._waiting[0] is first:
                    continue
                outcome = PostOutcome.DROPPED
            break
        # A flood of alarms may have pushed it out, and counted it, meanwhile.
        if self._waiting and self._waiting[0] is first:
            self._waiting.popleft()
            self._end(outcome)

    def _end(self, outcome: PostOutcome) -> None:
        self._counter.add(outcome.value)
