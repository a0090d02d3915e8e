"""The service put together: what each part is given, how they begin and how they end."""

from __future__ import annotations

import asyncio
import logging
import math
import re
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from concurrent.futures import Future
from contextlib import asynccontextmanager, suppress
from functools import lru_cache, partial
from typing import Any, TypeVar
from uuid import uuid4

from fastapi import FastAPI

from servotwin.errors import InvalidInput
from servotwin.messages import NAME_PATTERN
from servotwin.store.engine import StoreUnavailable
from servotwin.store.group_commit import CommitLimits, GroupCommit
from servotwin.store.records import Incoming, OutgoingMessage, PutResult, WorkResult
from servotwin.store.retention import delete_old_bodies
from servotwin.store.store import Store
from servotwin.twin.fleet import Fleet
from servotwin.twin_service import broker_desk
from servotwin.twin_service.app import make_app, refusal
from servotwin.twin_service.auth import Authority, TokenFile
from servotwin.twin_service.config import SQLITE
from servotwin.twin_service.dispatcher import Dispatcher, Parts
from servotwin.twin_service.edge_api import EdgeApi, Gate
from servotwin.twin_service.future import REMEMBERED, Boots
from servotwin.twin_service.ingest import Clocks, Ingest
from servotwin.twin_service.landing import Landing
from servotwin.twin_service.limits import Bodies, Buckets
from servotwin.twin_service.metrics import Metrics
from servotwin.twin_service.mqtt import Bridge
from servotwin.twin_service.outgoing import Outgoing
from servotwin.twin_service.pool import Pool
from servotwin.twin_service.proofs import Allowance
from servotwin.twin_service.read_api import ReadApi
from servotwin.twin_service.shelf import Shelf
from servotwin.twin_service.shortcut import Shortcut
from servotwin.twin_service.step_api import StepApi
from servotwin.twin_service.twin_file import TwinFile

log = logging.getLogger(__name__)
_What = TypeVar("_What")
_Result = TypeVar("_Result")

REFRESH_S, RETENTION_S, DAY = 1.0, 600.0, 86400.0
DOUBT_S = 60.0
"""After a write that failed, so long the store is not called well unless another one succeeds."""
ALONE = "twin"
"""Borrows everything where one process has the store to itself: after a crash its loans are its own."""


class System:
    """One process of the service.

    Parameters
    ----------
    twin : TwinFile
    store : Store
        Open; whoever opened it closes it, after `end`.
    clocks : Clocks, optional
    pool : Pool, optional
        Replaces the one that the file describes.
    """

    def __init__(self, twin: TwinFile, store: Store, clocks: Clocks | None = None, pool: Pool | None = None) -> None:
        self.config, self.store, self.clocks = twin.service, store, clocks or Clocks.of_machine()
        self.metrics, self.shelf, self._landing = Metrics(), Shelf(), Landing()
        self.pool = pool or Pool(self.config.workers, twin.start, self.config.job_timeout_s)
        self.tokens = None if self.config.tokens is None else TokenFile(self.config.tokens)
        self.authority = Authority(None) if self.tokens is None else self.tokens.authority
        alone, self._knows = self.config.store.startswith(SQLITE), knowing(twin.fleet)
        self._owner = ALONE if alone else uuid4().hex
        self.outgoing = Outgoing(self._posted, self.config.long_polls, shared=not alone)
        self.commits = GroupCommit(store, CommitLimits(waiting=self.config.queue), self.clocks.wall)
        self.ingest = self._ingest()
        self._parts = Parts(store, self.shelf, self.pool, self._commit, self.outgoing.post, self.metrics, self.clocks)
        self.dispatcher = Dispatcher(self._parts, self._owner, Allowance(self.config.proofs_per_minute))
        self._tasks: list[asyncio.Task[None]] = []
        self._failed_at = -math.inf
        self._buckets = Buckets(self.config.rate_limit_per_s, self.config.rate_burst, self.clocks.monotonic)
        self._bridge = self._over_mqtt()
        self._watch()

    @property
    def app(self) -> Shortcut:
        """The HTTP API; its lifespan begins and ends everything else."""
        gate, bodies = (
            Gate(self.authority, self._knows, self._buckets),
            Bodies(self.config.max_body_bytes, self.config.body_timeout_s),
        )
        edge = EdgeApi(gate, bodies, self.ingest, self.outgoing, self.dispatcher.poke)
        read = ReadApi(self.authority, self.store, self.shelf, self.health, self.metrics, self.clocks.wall)
        whole = gate, bodies, self.ingest, self._parts, self.dispatcher, self._owner
        step = StepApi(*whole) if self.config.lockstep else None
        api = make_app(edge, read, step, self.metrics, self._lifespan)
        return Shortcut(api, edge.put_window, edge.get_outgoing, partial(refusal, self.metrics))

    async def begin(self) -> None:
        """Take back what a crash left borrowed, start the workers, begin to work."""
        if self._owner == ALONE:
            await self.shelf.ask(partial(self.store.release, self._owner))
        await self.pool.begin()
        self._spawn(self._refresh())
        if self._owner != ALONE:
            self._spawn(self._hear())
        if not self.config.lockstep:
            self._spawn(self.dispatcher.run())
        if not math.isinf(self.config.retention_days):
            self._spawn(self._forget())
        if self._bridge is not None:
            await self._bridge.begin()

    async def end(self) -> None:
        """Commit what came, finish what is begun, end the workers."""
        self.outgoing.close()
        if self._bridge is not None:
            await self._bridge.end()
        await self.dispatcher.stop()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.pool.end()
        await asyncio.to_thread(self.commits.close)
        self.shelf.close()

    def health(self) -> dict[str, Any]:
        """What is well."""
        store, workers = self._storing(), self.pool.alive
        working = all(not task.done() for task in self._tasks)
        return {"ok": store and workers > 0 and working, "store": store, "workers": workers, "dispatching": working}

    def _ingest(self) -> Ingest:
        slack = math.inf if self.config.lockstep else self.config.future_slack_s
        boots = Boots(self.config.speed, slack)
        return Ingest(self._put, self._knows, boots, self.metrics, self.config.max_body_bytes, self.clocks)

    def _over_mqtt(self) -> Bridge | None:
        if self.config.mqtt is None:
            return None
        parts = broker_desk.Parts(
            self.authority, self._knows, self._buckets, self.ingest, self.outgoing, self.dispatcher.poke, self.metrics
        )
        return Bridge(self.config.mqtt.broker, broker_desk.Desk(parts), self.config.mqtt.group)

    async def _put(self, incoming: Incoming) -> PutResult:
        return await self._written(self.commits.put, incoming)

    async def _commit(self, outcome: WorkResult) -> bool:
        return await self._written(self.commits.commit, outcome)

    async def _written(self, write: Callable[[_What], Future[_Result]], what: _What) -> _Result:
        """What a write gives; that it failed is remembered until one succeeds again."""
        try:
            found = await self._landing(write(what))
        except StoreUnavailable:
            self._failed_at = self.clocks.monotonic()
            raise
        self._failed_at = -math.inf
        return found

    def _storing(self) -> bool:
        """Whether the last call and the last write succeeded, or it failed long ago: nobody may have tried since."""
        return not self.shelf.fault and self.clocks.monotonic() - self._failed_at >= DOUBT_S

    async def _posted(self, servo: str, serial: int) -> Sequence[OutgoingMessage]:
        return await self.shelf.ask(lambda: self.store.outgoing(servo, serial))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        task.add_done_callback(_told)
        self._tasks.append(task)

    async def _refresh(self) -> None:
        """Read the tokens again when their file is another one."""
        while self.tokens is not None:
            await asyncio.sleep(REFRESH_S)
            self.tokens.refresh()
        await asyncio.Event().wait()

    async def _hear(self) -> None:
        """Let edges know what other processes posted."""
        while True:
            await asyncio.sleep(REFRESH_S)
            with suppress(StoreUnavailable):
                self.outgoing.posted(await self.shelf.ask(partial(self.store.posted, self.outgoing.waiting)))

    async def _forget(self) -> None:
        """Empty windows that are too old."""
        while True:
            before = self.clocks.wall() - self.config.retention_days * DAY
            with suppress(StoreUnavailable):
                done = await self.shelf.ask(partial(delete_old_bodies, self.store, before))
                if done.emptied:
                    log.info("windows forgotten", extra=done._asdict())
            await asyncio.sleep(RETENTION_S)

    def _watch(self) -> None:
        """Gauges."""
        watch = self.metrics.watch
        watch(
            "servotwin_commit_waiting",
            "Messages and outcomes that wait for their commit.",
            lambda: self.commits.waiting,
        )
        watch("servotwin_polls", "Polls that wait for a message.", lambda: self.outgoing.polls)
        watch("servotwin_workers", "Worker processes that run.", lambda: self.pool.alive)
        bridge = self._bridge
        if bridge is not None:
            watch("servotwin_broker_connected", "Whether the MQTT broker is there.", lambda: bridge.connected)
        watch(
            "servotwin_store_ok", "Whether the store could do what it was asked last.", lambda: self.health()["store"]
        )

    @asynccontextmanager
    async def _lifespan(self, _app: FastAPI) -> AsyncIterator[None]:
        try:
            await self.begin()
            yield
        finally:
            await self.end()


def _told(task: asyncio.Task[None]) -> None:
    """Nobody waits for such a task before the end: what ended it is told at once."""
    if not task.cancelled() and (error := task.exception()) is not None:
        log.error("a task of the service ended", exc_info=error)


def knowing(fleet: Fleet) -> Callable[[str], bool]:
    """Whether a fleet has a servo of that name; what is no name at all, however long, is not remembered."""

    @lru_cache(maxsize=REMEMBERED)
    def has(servo: str) -> bool:
        try:
            fleet.model_of(servo)
        except InvalidInput:
            return False
        return True

    return lambda servo: re.match(NAME_PATTERN, servo) is not None and has(servo)
