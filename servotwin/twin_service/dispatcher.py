"""Dispatcher: leases servos with pending work, has workers process them, commits the results.

Whatever happens to a worker, or to this process, a message stays unprocessed until a result that covers it is
committed, and that happens once.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Sequence
from contextlib import suppress
from functools import partial

from servotwin.store.engine import ServoSetAside, StoreUnavailable
from servotwin.store.leases import LONGEST_HOLD_S
from servotwin.store.records import Lease, MessageKind, WorkResult
from servotwin.store.store import WORK_KINDS, Store
from servotwin.twin_service.evidence_lines import count_evidence, write_evidence
from servotwin.twin_service.ingest import Clocks
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.pace import EstimateShare, VerificationQuota, WorkPace
from servotwin.twin_service.store_executor import StoreExecutor
from servotwin.twin_service.uncommitted_results import UncommittedResults
from servotwin.twin_service.update_pace import UpdatePace
from servotwin.twin_service.worker import LeaseResult, WorkerLost, WorkerProcess
from servotwin.twin_service.worker_pool import WorkerPool

log = logging.getLogger(__name__)

LEASE_S, _POLL_S, _RETRY_S = 10.0, 0.5, 1.0
"""A lease is short, so that those of a process that was killed, or of a database that was restored, soon end by
themselves: no other process can tell whether their owner lives."""
_RENEWALS = 4.0
"""Renewals of a lease within its time while a worker is at work, however long that takes."""
_GATHER_S = 0.02
"""s from a job that was not full to the next one of new messages: a lease takes as long as ten servos in it."""
_MESSAGES = 16
"""Messages of each servo in a job, at most."""
_MAX_STEPS = 64
"""Results that one lock-step request may lead to."""


class NoResult(Exception):
    """A worker failed, or its result could not be committed; the messages stay unprocessed."""


class Dispatcher:
    """Keeps the worker pool busy.

    Parameters
    ----------
    store, executor : Store, StoreExecutor
    pool : WorkerPool
    commit : callable
        Commits a WorkResult; False: it is void. Raises StoreUnavailable.
    notify : callable
        Called with a servo that has new outgoing messages.
    metrics : Metrics
    clocks : Clocks
    owner : str
        Of the leases.
    quota : VerificationQuota
    pace : WorkPace, optional
    updates : UpdatePace, optional
    paused : callable
        True while nothing new is to be begun.
    note : callable
        Called with each lease and its result, once that is committed.
    speed : float
        Least ratio of sample time to real time.

    Attributes
    ----------
    away : str
        Why no work can be taken from the store now; empty: it can.
    """

    def __init__(
        self,
        store: Store,
        executor: StoreExecutor,
        pool: WorkerPool,
        commit: Callable[[WorkResult], Awaitable[bool]],
        notify: Callable[[str], None],
        metrics: Metrics,
        clocks: Clocks,
        owner: str,
        quota: VerificationQuota,
        pace: WorkPace | None = None,
        updates: UpdatePace | None = None,
        speed: float = 1.0,
        paused: Callable[[], bool] = lambda: False,
        note: Callable[[Lease, WorkResult], None] = lambda *_: None,
    ) -> None:
        self._store, self._executor, self._pool = store, executor, pool
        self._commit, self._notify, self._metrics, self._clocks = commit, notify, metrics, clocks
        self._owner, self._quota, self._note = owner, quota, note
        self._pace, self._speed, self._paused = pace or WorkPace(), speed, paused
        self._updates, self._estimates = updates or UpdatePace(lambda _servo: None, clocks), EstimateShare()
        self._deferred, self._next_job = set[str](), 0.0
        self._work_pending = asyncio.Event()
        self._stopping, self._waited_for, self._latest = False, False, set[str]()
        self.away, self._not_committed, self._uncommitted = "", False, UncommittedResults()
        self._tasks: set[asyncio.Task[None]] = set()
        self._to_release: set[str] = set()
        self._failures: Counter[_Queue] = Counter()

    def wake(self) -> None:
        """Look for work now."""
        self._work_pending.set()

    async def run(self) -> None:
        """Dispatch until `stop`."""
        while not self._stopping:
            worker = await self._pool.acquire()
            # After a worker is free: a lease that waited for one would lose a part of its time, and other processes
            # could not take it.
            self._waited_for = True  # unless there is nothing to do
            leases = await self._next_leases()
            if not leases:
                self._pool.release(worker)
                continue
            servos = {lease.servo for lease in leases}
            # Servos come in turns: where one comes twice in a row, no other waits.
            others_wait = self._waited_for and servos != self._latest
            self._latest = servos if len(servos) == 1 else set()
            task = asyncio.create_task(self._employ(worker, leases, others_wait))
            self._tasks.add(task)
            # The loop has weak references to tasks only; the set keeps this one from being collected.
            task.add_done_callback(self._tasks.discard)

    async def stop(self) -> None:
        """Start nothing new, give what is running some time, release the leases."""
        self._stopping = True
        self._work_pending.set()  # ends the rest of `run`
        if self._tasks:
            await self._pool.finish(self._tasks)
        try:
            await self._executor.run(partial(self._store.release, self._owner))
        except StoreUnavailable as error:
            log.warning("leases not released", extra={"why": str(error)})

    async def process(self, servo: str, now: float) -> list[bytes]:
        """Work on one servo until nothing is pending, for lock-step; returns its outgoing messages.

        Raises
        ------
        NoResult, StoreUnavailable, WorkerLost
        """
        sent: list[bytes] = []
        worker = await self._pool.acquire()
        try:
            for _ in range(_MAX_STEPS):
                leases = await self._executor.run(
                    lambda: self._store.lease(self._owner, 1, LEASE_S, now, tuple(MessageKind), servo=servo)
                )
                if not leases:
                    break
                result: WorkResult | None = None
                async for done in worker.work(leases[:1], now):
                    result = await self._complete(leases[0], done, now)
                if result is None:
                    raise NoResult(f"servo {servo!r}: no result was committed")
                sent += result.outgoing
        except WorkerLost as lost:
            await self._pool.replace(worker, str(lost))
            raise
        except BaseException:
            self._pool.release(worker)
            raise
        self._pool.release(worker)
        return sent

    async def _next_leases(self) -> list[Lease]:
        """Wait for pending work; returns nothing when the dispatcher is to stop."""
        while not self._stopping:
            # Cleared before the store is read: a message that comes meanwhile ends the rest that follows.
            self._work_pending.clear()
            if self._paused():
                await self._rest(_RETRY_S)
                continue
            if self._not_committed:  # not woken by new messages: the same work would be done and lost again
                self._not_committed = False
                await asyncio.sleep(_RETRY_S)
            try:
                await self._release_failed()
                leases = await self._lease_next()
            except StoreUnavailable as error:
                self.away = str(error)
                await self._rest(_RETRY_S)
                continue
            self.away = ""
            if leases:
                return leases
            self._waited_for = False
            await self._rest(_POLL_S)
        return []

    async def _lease_next(self) -> list[Lease]:
        """Lease a verification if the quota allows one, otherwise messages, or an estimate that was deferred."""
        now = self._clocks.wall()
        if self._quota.refill(self._clocks.monotonic()):
            verifications = await self._lease(now, 1, (MessageKind.VERIFICATION,))
            if verifications:
                self._quota.take()
                return verifications
        return await self._lease_work(now)

    async def _lease_work(self, now: float) -> list[Lease]:
        """Lease new messages, of many servos where many send, or an estimate: where one is due, or until then."""
        most, first = self._pace.servos, self._estimates.due
        if not first and (wait := self._next_job - self._clocks.monotonic()) > 0.0:
            first = bool(self._deferred)
            if not first:
                await asyncio.sleep(min(wait, _GATHER_S))
        leases = await self._lease(now, most, WORK_KINDS, first)
        if leases and not leases[0].estimate:
            self._next_job = self._clocks.monotonic() + (_GATHER_S if len(leases) < most else 0.0)
            if first:
                self._deferred.clear()  # those that are left wait for something else
        return leases

    async def _lease(
        self, now: float, servos: int, kinds: Collection[MessageKind], estimate_first: bool = False
    ) -> list[Lease]:
        return await self._executor.run(
            lambda: self._store.lease(
                self._owner,
                servos,
                LEASE_S,
                now,
                kinds,
                per_servo=_MESSAGES,
                newest_first=True,
                estimate_first=estimate_first,
            )
        )

    async def _rest(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._work_pending.wait()
        except TimeoutError:
            return

    async def _employ(self, worker: WorkerProcess, leases: Sequence[Lease], others_wait: bool) -> None:
        """Let a worker process leases; those that failed before each in a job of its own, which isolates the fault.

        `others_wait`: other servos waited for a worker, when these were leased.
        """
        # Failures of this process, not the store's count of leases: that also rises where a worker was lost to another
        # lease.
        leases = [lease._replace(attempts=1 + self._failures[_queue(lease)]) for lease in leases]
        jobs = [
            [lease for lease in leases if lease.attempts == 1],
            *([lease] for lease in leases if lease.attempts > 1),
        ]
        left = dict.fromkeys(lease.servo for job in jobs for lease in job)
        commits: list[asyncio.Task[WorkResult | None]] = []
        # Of several servos the last one would wait for the estimates of all before it.
        defer = others_wait or len(leases) > 1
        renewal = asyncio.create_task(self._renew(left))
        try:
            for job in filter(None, jobs):
                waiting, now = iter(job), self._clocks.wall()
                expected = [self._updates.expected(lease.servo) for lease in job]
                urgency = [(seconds, self._speed, others_wait, defer) for seconds in expected]
                async for done in worker.work(job, now, urgency):
                    lease = next(waiting)
                    del left[lease.servo]
                    commits.append(asyncio.create_task(self._complete(lease, done, now, others_wait)))
        except WorkerLost as lost:
            await self._lost(worker, leases, list(left), str(lost))
        else:
            self._pool.release(worker)
        finally:
            renewal.cancel()
            if _queue(leases[0])[1] == _VERIFICATION:
                self._quota.ended()
        await asyncio.gather(*commits)

    async def _renew(self, left: Collection[str]) -> None:
        """Renew the leases of servos that a worker has not finished, so that no other process takes them meanwhile."""
        while True:
            await asyncio.sleep(LEASE_S / _RENEWALS)
            until, servos = self._clocks.wall() + LEASE_S, frozenset(left)
            with suppress(StoreUnavailable):
                await self._executor.run(partial(self._store.renew, self._owner, servos, until))

    async def _lost(self, worker: WorkerProcess, leases: Sequence[Lease], left: Sequence[str], why: str) -> None:
        """Replace a lost worker: the lease that it was processing failed, those after it are released."""
        self._metrics.workers_lost.add()
        current = next(lease for lease in leases if lease.servo == left[0]) if left else None
        if current is not None:
            self._fail(current, why)
        self._to_release.update(left[1:])
        if not self._stopping:
            await self._pool.replace(worker, why)
        self.wake()

    async def _complete(
        self, lease: Lease, done: LeaseResult, now: float, others_wait: bool = False
    ) -> WorkResult | None:
        """Commit a worker's result; None: there is none, and the servo is to be released."""
        self._metrics.work.observe(done.seconds)
        # What has no windows takes a moment: after a quiet hour every servo would seem to.
        if any(message.kind is MessageKind.WINDOW for message in lease.messages):
            if not lease.estimate:
                self._pace.note(done.seconds)
            self._estimates.note(done.seconds, lease.estimate)
        if done.result is None:
            self._fail(lease, done.error)
            return None
        self._updates.note_work(done.result, done.seconds)
        if not await self._committed(done.result):
            return None
        self._failures.pop(_queue(lease), None)
        self._updates.note_ways(lease, done.result)
        if done.result.deferred:
            self._deferred.add(lease.servo)
        elif lease.estimate:
            self._deferred.discard(lease.servo)
        if others_wait:
            await self._hold(lease.servo, done.seconds)
        self._report(lease, done.result, done.seconds, now)
        return done.result

    async def _hold(self, servo: str, seconds: float) -> None:
        """Let the other servos come first after one that took long."""
        if hold := self._pace.hold(seconds):
            until = self._clocks.wall() + min(hold, LONGEST_HOLD_S)
            with suppress(StoreUnavailable):
                await self._executor.run(partial(self._store.hold, servo, until))

    async def _committed(self, result: WorkResult) -> bool:
        counts = self._metrics.results
        try:
            valid = await self._commit(result)
        except StoreUnavailable as error:
            counts.add("not committed")
            if isinstance(error, ServoSetAside):  # others go on, and its lease ends by itself
                return False
            self._not_committed = True
            self._uncommitted.failed(self._clocks.monotonic(), servo=result.servo, why=str(error))
            self._to_release.add(result.servo)
            return False
        self._uncommitted.over()
        # A void result has no lease to release: the result before it ended that, and its present owner needs it.
        counts.add("committed" if valid else "void")
        if valid and result.outgoing:
            self._metrics.sent.add(by=len(result.outgoing))
            self._notify(result.servo)
        if valid:
            self.wake()
        return valid

    def _fail(self, lease: Lease, why: str) -> None:
        """Count a failure: the next worker learns the number of attempts, and finally gives the message up."""
        self._failures[_queue(lease)] += 1
        self._metrics.results.add("failed")
        about = {"servo": lease.servo, "message_id": lease.messages[0].id if lease.messages else 0}
        log.error("work failed", extra={**about, "faults": self._failures[_queue(lease)], "why": why})
        self._to_release.add(lease.servo)

    async def _release_failed(self) -> None:
        """Release the servos that have no result."""
        servos = frozenset(self._to_release)
        if servos:
            await self._executor.run(partial(self._store.release, self._owner, servos))
            self._to_release -= servos

    def _report(self, lease: Lease, result: WorkResult, seconds: float, now: float) -> None:
        """Count and log a committed result."""
        for message in lease.messages:
            if message.id != result.deferred:
                self._metrics.age.observe(max(0.0, now - message.received))
        count_evidence(self._metrics, result)
        write_evidence(log, lease, result, seconds)
        self._note(lease, result)


_Queue = tuple[str, str]
"""(servo, kind of its turn), the key of the failure count."""
_VERIFICATION, _ESTIMATE, _NEW = "verification", "estimate", "new"


def _queue(lease: Lease) -> _Queue:
    """Windows that succeed do not reset the count of a verification, or of an estimate, that kills workers."""
    if any(message.kind is MessageKind.VERIFICATION for message in lease.messages):
        return lease.servo, _VERIFICATION
    return lease.servo, _ESTIMATE if lease.estimate else _NEW
