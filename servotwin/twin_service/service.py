"""The service: its parts, how they are connected, started and stopped."""

from __future__ import annotations

import asyncio
import logging
import math
import re
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager, suppress
from functools import lru_cache, partial
from typing import Any
from uuid import uuid4

from servotwin import __version__
from servotwin.messages import NAME_PATTERN
from servotwin.store.engine import StoreUnavailable
from servotwin.store.group_commit import AwaitedCommits, CommitLimits, GroupCommit
from servotwin.store.records import OutgoingMessage
from servotwin.store.retention import delete_old_bodies
from servotwin.store.store import Store
from servotwin.twin.servo_names import ServoNames
from servotwin.twin_service.auth import AccessControl, EdgeGate, TokenFile
from servotwin.twin_service.claims import EdgeClaims
from servotwin.twin_service.config import SQLITE
from servotwin.twin_service.dispatcher import Dispatcher, VerificationQuota
from servotwin.twin_service.http_app import HttpApp
from servotwin.twin_service.http_edge import EdgeApi, LongPolls
from servotwin.twin_service.http_lockstep import LockstepApi
from servotwin.twin_service.http_operator import OperatorApi
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.ingest import Clocks, Ingest
from servotwin.twin_service.limits import MAX_SERVOS, RateLimiter, SampleTimeLimiter
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.mqtt import MqttRequestHandler, MqttServer
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.twin_file import TwinFile
from servotwin.twin_service.worker import WorkerPool

log = logging.getLogger(__name__)

_REFRESH_S, _RETENTION_S, _DAY = 1.0, 600.0, 86400.0
_UNHEALTHY_S = 60.0
"""s for which the store counts as unhealthy after a failed write, unless a later one succeeds."""
_SOLE_OWNER = "twin"
"""Owner of all leases where one process has the store to itself: after a crash it releases its own."""


class TwinService:
    """One process of the service.

    Parameters
    ----------
    twin : TwinFile
    store : Store
        Open; the caller closes it, after `stop`.
    clocks : Clocks, optional
    pool : WorkerPool, optional
        Replaces the one that the file describes; it may have been launched.
    """

    def __init__(
        self, twin: TwinFile, store: Store, clocks: Clocks | None = None, pool: WorkerPool | None = None
    ) -> None:
        config = twin.service
        self.config, self.store, self.clocks = config, store, clocks or Clocks.of_machine()
        self.metrics, self.executor = Metrics(), StoreExecutor()
        self.pool = pool or WorkerPool(config.workers, twin.start, config.job_timeout_s)
        self.tokens = None if config.tokens is None else TokenFile(config.tokens)
        self.access = AccessControl(None) if self.tokens is None else self.tokens.access
        self._shared = not config.store.startswith(SQLITE)
        # On a shared database another process may run: only a name of its own tells whose leases are whose.
        self._owner = uuid4().hex if self._shared else _SOLE_OWNER
        self.polls = LongPolls(self._read_outgoing, config.long_polls, shared=self._shared)
        self.commits = GroupCommit(store, CommitLimits(waiting=config.queue), self.clocks.wall)
        self._writes = AwaitedCommits(self.commits, self.clocks.monotonic)
        has_servo = _servo_test(twin.servos)
        slack = math.inf if config.lockstep else config.future_slack_s
        self.ingest = Ingest(
            put=self._writes.put,
            has_servo=has_servo,
            sample_times=SampleTimeLimiter(config.speed, slack),
            metrics=self.metrics,
            limit=config.max_body_bytes,
            clocks=self.clocks,
        )
        self.gate = EdgeGate(
            self.access, has_servo, RateLimiter(config.rate_limit_per_s, config.rate_burst, self.clocks.monotonic)
        )
        self.dispatcher = Dispatcher(
            store=store,
            executor=self.executor,
            pool=self.pool,
            commit=self._writes.commit,
            notify=self.polls.notify,
            metrics=self.metrics,
            clocks=self.clocks,
            owner=self._owner,
            quota=VerificationQuota(config.verifications_per_minute),
        )
        self.claims = EdgeClaims(
            store, self.executor, self.polls.evict, self.metrics, self.clocks, self._shared, __version__
        )
        self._mqtt: MqttServer | None = None
        if config.mqtt is not None:
            handler = MqttRequestHandler(
                self.gate, self.ingest, self.polls, self.claims, self.dispatcher.wake, self.metrics
            )
            self._mqtt = MqttServer(config.mqtt.broker, handler, config.mqtt.group)
        self._tasks: list[asyncio.Task[None]] = []
        self._add_gauges()

    def http_app(self) -> HttpApp:
        """HTTP application, whose lifespan starts and stops the service."""
        bodies = BodyReader(self.config.max_body_bytes, self.config.body_timeout_s)
        edge = EdgeApi(self.gate, bodies, self.ingest, self.polls, self.claims, self.dispatcher.wake)
        operator = OperatorApi(self.access, self.store, self.executor, self.health, self.metrics, self.clocks.wall)
        routes = [*edge.routes(), *operator.routes()]
        if self.config.lockstep:
            lockstep = LockstepApi(self.gate, bodies, self.ingest, self.store, self.executor, self.dispatcher)
            routes += lockstep.routes()
        return HttpApp(routes, self.metrics, self._lifespan)

    async def start(self) -> None:
        """Release the leases that a crash left behind, start the workers and the dispatcher."""
        if not self._shared:
            # The store is locked for this process, so that every lease is one of a process that has ended.
            await self.executor.run(partial(self.store.release, self._owner))
        await self.pool.start()
        self._spawn(self._refresh_tokens())
        if self._shared:
            self._spawn(self._poll_outgoing())
        if not self.config.lockstep:
            self._spawn(self.dispatcher.run())
        if not math.isinf(self.config.retention_days):
            self._spawn(self._apply_retention())
        if self._mqtt is not None:
            await self._mqtt.start()

    async def stop(self) -> None:
        """Commit the received messages, finish the running work, stop the workers."""
        # Sources of requests first and the writer last: it still commits the results of the work that is finished.
        self.polls.close()
        if self._mqtt is not None:
            await self._mqtt.stop()
        await self.dispatcher.stop()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.pool.stop()
        await asyncio.to_thread(self.commits.close)
        self.executor.close()

    def health(self) -> dict[str, Any]:
        """Health of each part, and "ok" for all."""
        store, workers = self._store_healthy(), self.pool.alive
        dispatching = all(not task.done() for task in self._tasks)
        ok = store and workers > 0 and dispatching
        return {"ok": ok, "store": store, "workers": workers, "dispatching": dispatching}

    def _store_healthy(self) -> bool:
        """Last read and last write succeeded, or that write failed long ago: none may have been tried since."""
        return not self.executor.fault and self.clocks.monotonic() - self._writes.failed_at >= _UNHEALTHY_S

    async def _read_outgoing(self, servo: str, after: int) -> Sequence[OutgoingMessage]:
        return await self.executor.run(lambda: self.store.outgoing(servo, after))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        task.add_done_callback(_log_failure)
        self._tasks.append(task)

    async def _refresh_tokens(self) -> None:
        """Read the file of tokens again whenever it was replaced."""
        while self.tokens is not None:
            await asyncio.sleep(_REFRESH_S)
            self.tokens.refresh()
        await asyncio.Event().wait()

    async def _poll_outgoing(self) -> None:
        """Notify polls of messages that other processes posted."""
        while True:
            await asyncio.sleep(_REFRESH_S)
            with suppress(StoreUnavailable):
                self.polls.notify_serials(await self.executor.run(partial(self.store.posted, self.polls.waiting)))

    async def _apply_retention(self) -> None:
        """Delete the bodies of windows that are too old."""
        while True:
            before = self.clocks.wall() - self.config.retention_days * _DAY
            with suppress(StoreUnavailable):
                done = await self.executor.run(partial(delete_old_bodies, self.store, before))
                if done.emptied:
                    log.info("old window bodies deleted", extra=done._asdict())
            await asyncio.sleep(_RETENTION_S)

    def _add_gauges(self) -> None:
        add = self.metrics.add_gauge
        waiting = "Messages and results that wait for their commit."
        add("servotwin_commit_waiting", waiting, lambda: self.commits.waiting)
        add("servotwin_polls", "Polls that wait for a message.", lambda: self.polls.open)
        add("servotwin_workers", "Worker processes that run.", lambda: self.pool.alive)
        mqtt = self._mqtt
        if mqtt is not None:
            add("servotwin_broker_connected", "1 while the MQTT broker is connected.", lambda: mqtt.connected)
        add(
            "servotwin_store_ok",
            "1 while the store is healthy: its last read and write succeeded.",
            lambda: self.health()["store"],
        )

    @asynccontextmanager
    async def _lifespan(self) -> AsyncIterator[None]:
        try:
            await self.start()
            yield
        finally:
            await self.stop()


def _log_failure(task: asyncio.Task[None]) -> None:
    """Log the exception of a background task at once: the task is awaited only when the service stops."""
    if not task.cancelled() and (error := task.exception()) is not None:
        log.error("a task of the service ended", exc_info=error)


def _servo_test(servos: ServoNames) -> Callable[[str], bool]:
    """Test whether there is a servo of a name; invalid names, however long, are not cached."""

    @lru_cache(maxsize=MAX_SERVOS)
    def has(servo: str) -> bool:
        return servos.model_of(servo) is not None

    return lambda servo: re.match(NAME_PATTERN, servo) is not None and has(servo)
