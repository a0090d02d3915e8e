"""The service: its parts, how they are connected, started and stopped."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import Any
from uuid import uuid4

from servotwin import __version__
from servotwin.store.clock_gaps import old_messages
from servotwin.store.engine import StoreUnavailable
from servotwin.store.group_commit import AwaitedCommits, CommitLimits, GroupCommit
from servotwin.store.records import Backlog, OutgoingMessage, PutResult
from servotwin.store.retention import RetentionResult, delete_old_bodies
from servotwin.store.store import Store
from servotwin.twin_service.alarm_webhook import OF_ALL, AlarmWebhook
from servotwin.twin_service.auth import AccessControl, EdgeGate, TokenFile
from servotwin.twin_service.backlog_pace import BacklogPace
from servotwin.twin_service.claims import EdgeClaims
from servotwin.twin_service.clock_check import ClockCheck
from servotwin.twin_service.config import SQLITE
from servotwin.twin_service.dispatcher import Dispatcher
from servotwin.twin_service.fleet_reader import EdgePresence
from servotwin.twin_service.http_acts import ActsApi
from servotwin.twin_service.http_app import HttpApp
from servotwin.twin_service.http_edge import EdgeApi, LongPolls
from servotwin.twin_service.http_lockstep import LockstepApi
from servotwin.twin_service.http_operator import OperatorApi
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.http_webhook import WebhookApi
from servotwin.twin_service.ingest import Clocks, Ingest
from servotwin.twin_service.limits import MAX_SERVOS, RateLimiter, SampleTimeLimiter, daily_bytes_limiter
from servotwin.twin_service.missing_windows import MissingWindows, SequenceWatch
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.mqtt import MqttRequestHandler, MqttServer
from servotwin.twin_service.pace import VerificationQuota, WorkPace
from servotwin.twin_service.page_service import PageService
from servotwin.twin_service.refusals import Refusals
from servotwin.twin_service.sessions import OperatorAccess
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.store_health import StoreHealth
from servotwin.twin_service.store_watch import StoreWatch
from servotwin.twin_service.tls_expiry import CertificateExpiry
from servotwin.twin_service.twin_file import TwinFile
from servotwin.twin_service.unauthenticated import UnauthenticatedLimit
from servotwin.twin_service.update_pace import UpdatePace
from servotwin.twin_service.webhook import WebhookConfig
from servotwin.twin_service.worker_pool import WorkerPool, pool_of
from servotwin.twin_service.wrong_tokens import WrongTokens

log = logging.getLogger(__name__)

_REFRESH_S, _WATCH_S, _RETENTION_S, _DAY = 1.0, 5.0, 600.0, 86400.0
_LEAST_DELETED = 4096
"""Windows that one pass of retention may empty, beside twice those that came since the pass before: it keeps pace, and
a mistake does not cost the past at once."""
_ALARM = "alarm"
"""Kind of the evidence that is stored with a sentence."""
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
        self.pool = pool or pool_of(twin)
        self.tokens = None if config.tokens is None else TokenFile(config.tokens)
        self.access = AccessControl(None) if self.tokens is None else self.tokens.access
        self.operators = OperatorAccess(self.access, self.clocks.wall, config.encrypted)
        self.unauthenticated = UnauthenticatedLimit.of(config, self.access, self.operators)
        self._certificate = CertificateExpiry(config, self.clocks.wall)
        self._clock = ClockCheck(store, self.executor, self.clocks.wall)
        repeat = WebhookConfig.repeat if config.webhook is None else config.webhook.repeat
        self.wrong_tokens = WrongTokens(self._is_enrolled, repeat, self.clocks.monotonic)
        self._refusals = Refusals(self.metrics, self.wrong_tokens.note, self.access.owner_of, self.clocks.monotonic)
        self._shared = not config.store.startswith(SQLITE)
        # On a shared database another process may run: only a name of its own tells whose leases are whose.
        self._owner = uuid4().hex if self._shared else _SOLE_OWNER
        self.polls = LongPolls(self._read_outgoing, config.long_polls, self._shared, config.polls_per_servo)
        # In lock-step somebody waits for each result.
        limits = CommitLimits(waiting=config.queue, gather=0.0 if config.lockstep else CommitLimits().gather)
        self.commits = GroupCommit(store, limits, self.clocks.wall)
        self._writes = AwaitedCommits(self.commits, self.clocks.monotonic)
        writes = self._writes.put, self._writes.commit
        self.watch = StoreWatch(store, self.executor, *writes, self.clocks.wall, self.clocks.monotonic, twin.path)
        # In lock-step everything is worked on in order, however long it takes.
        work = self._work_pace = WorkPace(1.0 if config.lockstep else config.worker_share)
        self._pace = BacklogPace(self.clocks.monotonic, config.lag_limit_s, lambda: work.seconds / config.workers)
        sequences = SequenceWatch(self.clocks.monotonic, self._pace.holds)
        self._missing = MissingWindows(
            store, self.executor, sequences, self.polls.notify, self.metrics, self.clocks.wall, self._announce
        )
        has_servo = twin.servos.test(MAX_SERVOS)
        self.ingest = self._make_ingest(has_servo, sequences)
        limiter = partial(RateLimiter, config.rate_limit_per_s, config.rate_burst, self.clocks.monotonic)
        self.gate = EdgeGate(self.access, has_servo, limiter("messages"), limiter("polls"))
        self.webhook: AlarmWebhook | None = None
        if config.webhook is not None:
            self.webhook = AlarmWebhook(config.webhook, self.metrics.webhook, self.clocks.wall, self.clocks.monotonic)
        self.dispatcher = self._make_dispatcher(twin.servos.model_of)
        away, damage, cut = lambda: self.dispatcher.away, lambda: self.watch.fault, store.engines.opened.cut
        self._store_health = StoreHealth(self.executor, self._writes, away, damage, cut, self.clocks.monotonic)
        self.claims = self._make_claims()
        only_here = config.mqtt is None and not self._shared
        presence = EdgePresence(lambda: self.polls.waiting, only_here, self.clocks.monotonic)
        self.pages = PageService(twin, store, damage, presence, self.claims, self.clocks, self._shared, self.executor)
        self._mqtt: MqttServer | None = None
        if config.mqtt is not None:
            live = self.pages.live_intake
            handler = MqttRequestHandler(
                self.gate, self.ingest, self.polls, self.claims, live, self.dispatcher.wake, self._refusals,
                self.metrics.repeated,
            )  # fmt: skip
            self._mqtt = MqttServer(config.mqtt.broker, handler, config.mqtt.group)
        self._tasks: list[asyncio.Task[None]] = []
        self._vital: list[asyncio.Task[None]] = []
        self._add_gauges()

    def _make_ingest(self, has_servo: Callable[[str], bool], sequences: SequenceWatch) -> Ingest:
        config = self.config
        slack = math.inf if config.lockstep else config.future_slack_s
        return Ingest(
            put=self.watch.put,
            has_servo=has_servo,
            sample_times=SampleTimeLimiter(config.speed, slack),
            metrics=self.metrics,
            limit=config.max_body_bytes,
            clocks=self.clocks,
            note=sequences.note,
            samples=config.samples_per_window,
            disk=daily_bytes_limiter(config.megabytes_per_day, self.clocks.monotonic),
            conflict=lambda servo, boot, sequence: self.claims.conflicting(servo, boot, sequence),
            pace=None if config.lockstep else self._pace,
        )

    def _make_dispatcher(self, model_of: Callable[[str], str | None]) -> Dispatcher:
        config = self.config
        return Dispatcher(
            store=self.store,
            executor=self.executor,
            pool=self.pool,
            commit=self.watch.commit,
            notify=self.polls.notify,
            metrics=self.metrics,
            clocks=self.clocks,
            owner=self._owner,
            quota=VerificationQuota(config.verifications_per_minute, config.workers),
            pace=self._work_pace,
            updates=UpdatePace(model_of, self.clocks),
            speed=min(1.0, config.speed),
            paused=lambda: bool(self.watch.fault),
            note=(lambda *_: None) if self.webhook is None else self.webhook.note,
        )

    def _make_claims(self) -> EdgeClaims:
        config = self.config
        return EdgeClaims(
            self.store,
            self.executor,
            self.polls.evict,
            self.metrics,
            self.clocks,
            self._shared,
            __version__,
            self._announce,
            samples_per_window=config.samples_per_window,
            bytes_per_day=0 if math.isinf(config.megabytes_per_day) else round(config.megabytes_per_day * 1e6),
        )

    def http_app(self) -> HttpApp:
        """HTTP application, whose lifespan starts and stops the service."""
        bodies = BodyReader(self.config.max_body_bytes, self.config.body_timeout_s)
        edge = EdgeApi(self.gate, bodies, self.ingest, self.polls, self.claims, self.dispatcher.wake)
        operator = OperatorApi(
            self.operators, self.store, self.executor, self.pages.readers, self.health, self.metrics, self.clocks.wall
        )
        acts = ActsApi(
            self.operators, self.store, self.pages.readers, self.watch.put, self.dispatcher.wake, self.clocks.wall,
            self.clocks.monotonic,
        )  # fmt: skip
        webhook = WebhookApi(self.operators, self.config.webhook, self.clocks.monotonic)
        parts = edge, operator, acts, webhook
        routes = [route for part in parts for route in part.routes()]
        routes += self.pages.routes(self.gate, self.operators)
        if self.config.lockstep:
            lockstep = LockstepApi(self.gate, bodies, self.ingest, self.store, self.executor, self.dispatcher)
            routes += lockstep.routes()
        return HttpApp(routes, self._refusals, self._lifespan, own_names=self.tokens is None)

    async def start(self) -> None:
        """Release the leases that a crash left behind, start the workers and the dispatcher."""
        await self.watch.start()
        if not self._shared and not self.watch.fault:
            # The store is locked for this process, so that every lease is one of a process that has ended.
            with suppress(StoreUnavailable):  # a full disk: the leases end by themselves
                await self.executor.run(partial(self.store.release, self._owner))
        await self.pool.start()
        self._spawn(self._refresh_tokens())
        self._spawn(self._certificate.watch(self._announce), vital=False)
        self._spawn(self._clock.tell(self._announce), vital=False)
        self._spawn(self.wrong_tokens.watch(self._announce), vital=False)
        self._spawn(self._store_health.watch(self._announce), vital=False)
        self._spawn(self._store_health.run_write(self.store.write_nothing), vital=False)
        self._spawn(self.pages.feed.run(), vital=False)
        self._spawn(self.pages.what_if.run())
        if self.webhook is not None:
            self._spawn(self.webhook.run())
            self._spawn(self.watch.tell(self._announce), vital=False)
        if self._shared:
            self._spawn(self._poll_outgoing())
        if not self.config.lockstep:
            self._spawn(self.dispatcher.run())
            self._spawn(self._watch_lag())
            self._spawn(self._pace.run(lambda: self.executor.run(lambda: self.store.turn_lag(self.clocks.wall()))))
            self._spawn(self._missing.run())
            self._spawn(self.watch.run())
            self._spawn(self.watch.run_recheck(), vital=False)
            self._spawn(self.watch.run_mark())
            self._spawn(self.watch.run_lost(self.polls.notify), vital=False)
        if not math.isinf(self.config.retention_days):
            self._spawn(self._apply_retention())
        if self._mqtt is not None:
            await self._mqtt.start()

    def end_streams(self) -> None:
        """End all long polls, live views and event streams, which would otherwise keep the server from stopping."""
        self.polls.close()
        self.pages.end_streams()

    async def stop(self) -> None:
        """Commit the received messages, finish the running work, stop the workers."""
        # Sources of requests first and the writer last: it still commits the results of the work that is finished.
        self.end_streams()
        if self._mqtt is not None:
            await self._mqtt.stop()
        await self.dispatcher.stop()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.pages.stop()
        await self.pool.stop()
        await asyncio.to_thread(self.commits.close)
        with suppress(StoreUnavailable):
            if not self.watch.fault:
                await asyncio.to_thread(self.watch.mark)
        self.pages.close()
        self.executor.close()

    def health(self, backlog: Backlog | None = None) -> dict[str, Any]:
        """Health of each part, "ok" for all, and in "degraded" a sentence for all that works, but not as it should."""
        store = not self.watch.fault and not self._store_health.trouble
        workers, dispatching = self.pool.alive, self.dispatching
        parts = {"store": store, "damage": self.watch.fault, "set_aside": self.watch.aside}
        parts |= {"workers": workers, "dispatching": dispatching}
        fault = "" if self.tokens is None else self.tokens.fault
        former = [f"the former tokens stay in force: {fault}"] if fault else []
        own = *self._clock.sentences(), *self._certificate.sentences(), *self.wrong_tokens.sentences()
        away = [] if self._mqtt is None else self._mqtt.sentences()
        degraded = [*self._lagging(backlog), *former, *away, *own, *self.watch.sentences()]
        return {"ok": store and workers > 0 and dispatching, "degraded": degraded, **parts}

    @property
    def dispatching(self) -> bool:
        """False where a task without which no machine is served has failed; only a restart begins it again."""
        return not any(task.done() and not task.cancelled() and task.exception() for task in self._vital)

    def _lagging(self, backlog: Backlog | None) -> list[str]:
        """The lag in a sentence, where it is above its limit."""
        if backlog is None or backlog.lag <= self.config.lag_limit_s:
            return []
        return [f"new messages of a servo have waited for {backlog.lag:.0f} s, {backlog.messages} in all"]

    def _is_enrolled(self, servo: str) -> bool:
        return not self.access.open and self.access.verifier(servo) is not None

    async def _read_outgoing(self, servo: str, after: int) -> Sequence[OutgoingMessage]:
        messages, lost = await self.executor.run(lambda: self.watch.outgoing(servo, after))
        if lost:
            self.metrics.evidence.add(_ALARM)
            self._announce("the store has lost messages", lost, servo)
        return messages

    def _spawn(self, work: Coroutine[Any, Any, None], vital: bool = True) -> None:
        task = asyncio.create_task(work)
        task.add_done_callback(_log_failure)
        self._tasks.append(task)
        if vital:
            self._vital.append(task)

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

    async def _watch_lag(self) -> None:
        """Log when new messages begin to wait too long, and when they no longer do."""
        lagging = False
        while True:
            await asyncio.sleep(_WATCH_S)
            with suppress(StoreUnavailable):
                backlog = await self.executor.run(lambda: self.store.backlog(self.clocks.wall()))
                before, lagging = lagging, bool(self._lagging(backlog))
                figures = {"lag": round(backlog.lag, 1), "waiting": backlog.messages}
                if lagging and not before:
                    log.warning("updates lag", extra=figures)
                    # Always in the same words, so that a lag that comes and goes is not posted each time.
                    limit = self.config.lag_limit_s
                    self._announce("lag", f"new messages of a servo wait for longer than lag_limit_s = {limit:g} s")
                if before and not lagging:
                    log.info("updates lag no longer", extra=figures)

    def _announce(self, kind: str, sentence: str, servo: str = OF_ALL) -> None:
        """Post an alarm, where there is a webhook."""
        if self.webhook is not None:
            self.webhook.announce(kind, sentence, servo)

    async def _apply_retention(self) -> None:
        """Delete the bodies of windows that are too old: never at the start, where a wrong clock is set right."""
        age, stored = self.config.retention_days * _DAY, 0
        while True:
            await asyncio.sleep(_RETENTION_S)
            before, stored = stored, self.metrics.stored.values["window", PutResult.NEW.value]
            with suppress(StoreUnavailable):
                done = await self.executor.run(
                    partial(self._delete_old, age, _LEAST_DELETED + 2 * (stored - before)), slow=True
                )
                if done.emptied:
                    log.info("old window bodies deleted", extra=done._asdict())

    def _delete_old(self, age: float, most: int) -> RetentionResult:
        old = old_messages(self.store, self.clocks.wall(), age)
        if old.left_out > 0.0:
            log.warning("retention leaves out a gap", extra={"days": round(old.left_out / _DAY, 3)})
        return delete_old_bodies(self.store, old.through, most=most)

    def _add_gauges(self) -> None:
        add = self.metrics.add_gauge
        waiting = "Messages and results that wait for their commit."
        add("servotwin_commit_waiting", waiting, lambda: self.commits.waiting)
        unauthenticated = self.unauthenticated
        if unauthenticated is not None:
            shown = "Connections that have shown no token."
            add("servotwin_unauthenticated_connections", shown, lambda: unauthenticated.open)
        add("servotwin_polls", "Polls that wait for a message.", lambda: self.polls.open)
        add("servotwin_watchers", "Pages that watch the fleet.", lambda: self.pages.feed.watchers)
        add("servotwin_workers", "Worker processes that run.", lambda: self.pool.alive)
        add("servotwin_store_damaged", "1: the store is damaged, and not written.", lambda: bool(self.watch.fault))
        add("servotwin_servos_set_aside", "Servos whose record is damaged.", lambda: len(self.watch.aside))
        add("servotwin_store_checks", "Times that the whole store was checked.", lambda: self.watch.rounds)
        if (mqtt := self._mqtt) is not None:
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
