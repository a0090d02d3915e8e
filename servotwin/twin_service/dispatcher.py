"""Who works on what: servos with something to do are claimed, worked on by a pool, and their outcomes committed.

A claim is a loan. Whatever happens to a worker, or to this process, a message stays unprocessed until an outcome that
covers it is committed, and that happens once.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import EvidenceRecord, Lease, MessageKind, WorkResult
from servotwin.store.store import WORK_KINDS, Store
from servotwin.twin_service.ingest import Clocks
from servotwin.twin_service.job import Done
from servotwin.twin_service.metrics import Metrics
from servotwin.twin_service.pool import Pool, Worker, WorkerLost
from servotwin.twin_service.proofs import Allowance
from servotwin.twin_service.shelf import Shelf

log = logging.getLogger(__name__)

LEASE_S, REST_S, PAUSE_S = 120.0, 0.5, 1.0
SERVOS, MESSAGES = 16, 16
"""Servos in one job, and messages of each."""
QUIET = ("glance", "trend", "disturbance", "excitation")
"""Evidence that comes with every window."""
ALARMS = ("failed", "fallback", "withdrawn")
"""What somebody should look at."""


class Parts(NamedTuple):
    """What a dispatcher works with.

    Attributes
    ----------
    store : Store
    shelf : Shelf
    pool : Pool
    commit : callable
        Outcome -> whether it was valid, once that is committed; raises StoreUnavailable.
    posted : callable
        Told the servo for which there are new messages.
    metrics : Metrics
    clocks : Clocks
    """

    store: Store
    shelf: Shelf
    pool: Pool
    commit: Callable[[WorkResult], Awaitable[bool]]
    posted: Callable[[str], None]
    metrics: Metrics
    clocks: Clocks


class Dispatcher:
    """Keeps the pool busy.

    Parameters
    ----------
    parts : Parts
    owner : str
        Borrows under this name.
    proofs : Allowance
        How many proofs may be begun.
    """

    def __init__(self, parts: Parts, owner: str, proofs: Allowance) -> None:
        self._parts, self._owner, self._proofs = parts, owner, proofs
        self._came = asyncio.Event()
        self._stopping = False
        self._tasks: set[asyncio.Task[None]] = set()
        self._returns: set[str] = set()
        self._faults: Counter[tuple[str, bool]] = Counter()

    def poke(self) -> None:
        """Something new is to be worked on."""
        self._came.set()

    async def run(self) -> None:
        """Until `stop`."""
        while not self._stopping:
            worker = await self._parts.pool.lend()
            claims = await self._next()
            if not claims:
                self._parts.pool.take_back(worker)
                continue
            task = asyncio.create_task(self._employ(worker, claims))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def stop(self) -> None:
        """Begin nothing new, finish what is begun, give back what is borrowed."""
        self._stopping = True
        self._came.set()
        while self._tasks:
            await asyncio.wait(self._tasks)
        try:
            await self._parts.shelf.ask(partial(self._parts.store.release, self._owner))
        except StoreUnavailable as error:
            log.warning("leases not given back", extra={"why": str(error)})

    async def finish(self, claim: Lease, now: float, worker: Worker) -> WorkResult | None:
        """One claim, to its commit; None where there is no outcome, and the servo is free again."""
        outcome: WorkResult | None = None
        async for done in worker.work([claim], now):
            outcome = await self._settle(claim, done, now)
        return outcome

    async def _next(self) -> list[Lease]:
        """Claims, as soon as there are some; none when it is time to stop."""
        while not self._stopping:
            self._came.clear()
            try:
                await self._give_back()
                claims = await self._claim()
            except StoreUnavailable as error:
                log.error("store not available", extra={"why": str(error)})
                await self._rest(PAUSE_S)
                continue
            if claims:
                return claims
            await self._rest(REST_S)
        return []

    async def _claim(self) -> list[Lease]:
        now = self._parts.clocks.wall()
        if self._proofs.may(self._parts.clocks.monotonic()):
            proofs = await self._borrow(now, 1, (MessageKind.VERIFICATION,))
            if proofs:
                self._proofs.take()
                return proofs
        return await self._borrow(now, SERVOS, WORK_KINDS)

    async def _borrow(self, now: float, servos: int, kinds: Collection[MessageKind]) -> list[Lease]:
        store = self._parts.store
        return await self._parts.shelf.ask(
            lambda: store.lease(self._owner, servos, LEASE_S, now, kinds, per_servo=MESSAGES)
        )

    async def _rest(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._came.wait()
        except TimeoutError:
            return

    async def _employ(self, worker: Worker, claims: Sequence[Lease]) -> None:
        """Let a worker work on claims; those that failed before each alone, so that the fault is found."""
        claims = [claim._replace(attempts=1 + self._faults[_queue(claim)]) for claim in claims]
        jobs = [
            [claim for claim in claims if claim.attempts == 1],
            *([claim] for claim in claims if claim.attempts > 1),
        ]
        left = dict.fromkeys(claim.servo for job in jobs for claim in job)
        commits: list[asyncio.Task[WorkResult | None]] = []
        now = self._parts.clocks.wall()
        try:
            for job in filter(None, jobs):
                waiting = iter(job)
                async for done in worker.work(job, now):
                    claim = next(waiting)
                    del left[claim.servo]
                    commits.append(asyncio.create_task(self._settle(claim, done, now)))
        except WorkerLost as lost:
            await self._lost(worker, claims, list(left), str(lost))
        else:
            self._parts.pool.take_back(worker)
        await asyncio.gather(*commits)

    async def _lost(self, worker: Worker, claims: Sequence[Lease], left: Sequence[str], why: str) -> None:
        """A worker is gone: whom it was at is suspect, and all that it did not come to is free again."""
        self._parts.metrics.workers_lost.add()
        at = next(claim for claim in claims if claim.servo == left[0]) if left else None
        if at is not None:
            self._failed(at, why)
        self._returns.update(left[1:])
        await self._parts.pool.replace(worker, why)
        self.poke()

    async def _settle(self, claim: Lease, done: Done, now: float) -> WorkResult | None:
        """Commit what a worker made."""
        self._parts.metrics.work.observe(done.seconds)
        if done.outcome is None:
            self._failed(claim, done.error)
            return None
        if not await self._committed(done.outcome):
            return None
        self._faults.pop(_queue(claim), None)
        self._tell(claim, done.outcome, done.seconds, now)
        return done.outcome

    async def _committed(self, outcome: WorkResult) -> bool:
        counts = self._parts.metrics.outcomes
        try:
            valid = await self._parts.commit(outcome)
        except StoreUnavailable as error:
            counts.add("not committed")
            log.error("outcome not committed", extra={"servo": outcome.servo, "why": str(error)})
            self._returns.add(outcome.servo)
            return False
        # A void one has no lease to give back: the outcome before it ended that, and whoever has one now needs it.
        counts.add("committed" if valid else "void")
        if valid and outcome.outgoing:
            self._parts.metrics.posted.add(by=len(outcome.outgoing))
            self._parts.posted(outcome.servo)
        if valid:
            self.poke()
        return valid

    def _failed(self, claim: Lease, why: str) -> None:
        """A worker found no outcome: the next one is told how many did, and gives a message up at last."""
        self._faults[_queue(claim)] += 1
        self._parts.metrics.outcomes.add("failed")
        about = {"servo": claim.servo, "message_id": claim.messages[0].id if claim.messages else 0}
        log.error("work failed", extra={**about, "faults": self._faults[_queue(claim)], "why": why})
        self._returns.add(claim.servo)

    async def _give_back(self) -> None:
        """Free the servos without an outcome."""
        servos = frozenset(self._returns)
        if servos:
            await self._parts.shelf.ask(partial(self._parts.store.release, self._owner, servos))
            self._returns -= servos

    def _tell(self, claim: Lease, outcome: WorkResult, seconds: float, now: float) -> None:
        """Count it, and log what was found."""
        metrics = self._parts.metrics
        for message in claim.messages:
            metrics.age.observe(max(0.0, now - message.received))
        kinds = Counter(map(_what, outcome.evidence))
        for kind, number in kinds.items():
            metrics.evidence.add(kind, by=number)
        about = {"servo": claim.servo, "serial": claim.serial, "seconds": round(seconds, 6)}
        windows = {message.id: message.key for message in claim.messages if message.kind is MessageKind.WINDOW}
        for found in outcome.evidence:
            what = _what(found)
            level = logging.WARNING if what in ALARMS else logging.DEBUG if what in QUIET else logging.INFO
            if log.isEnabledFor(level):
                log.log(level, what, extra={**about, **_ids(found, windows)})


def _queue(claim: Lease) -> tuple[str, bool]:
    """Where its faults are counted: of a proof that kills its workers, windows that succeed meanwhile say nothing."""
    return claim.servo, any(message.kind is MessageKind.VERIFICATION for message in claim.messages)


def _what(found: EvidenceRecord) -> str:
    """Its kind; where nothing could be made of a message, whatever its kind, that."""
    return "failed" if found.status.startswith("failed") else found.kind


def _ids(found: EvidenceRecord, windows: Mapping[int, str]) -> dict[str, object]:
    """Of which window, under which version, in which context. An estimate is known by the message it was made of."""
    of = {"message_id": found.message, "window": windows.get(found.message)}
    known = {**of, "version": found.version, "status": found.status, "context": found.context}
    return {key: value for key, value in known.items() if value not in (None, "")}
