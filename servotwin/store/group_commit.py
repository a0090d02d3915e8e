"""Group commit: one thread commits all waiting writes in one transaction, then resolves their futures.

Threads wait for these futures; an event loop awaits them through `AwaitedCommits`.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple, TypeVar

from servotwin.store.engine import ServoSetAside, StoreBusy, StoreUnavailable
from servotwin.store.records import Incoming, PutResult, WorkResult
from servotwin.store.store import Store

_Record = TypeVar("_Record", Incoming, WorkResult)
_Result = TypeVar("_Result")


class CommitLimits(NamedTuple):
    """Limits of the queue and of one transaction.

    Attributes
    ----------
    waiting, waiting_bytes : int
        Messages, and bytes of their bodies, that may wait; more are rejected. Work results are always accepted: there
        is at most one per lease.
    together, together_bytes : int
        Messages and results in one transaction, and bytes of bodies.
    gather, enough : float, int
        s for which writes wait for others, until there are so many: a transaction takes as much processor time as ten
        writes in it. Where many edges send, enough come at once, and nothing waits.
    """

    waiting: int = 4096
    waiting_bytes: int = 128 * 1024 * 1024
    together: int = 256
    together_bytes: int = 8 * 1024 * 1024
    gather: float = 0.01
    enough: int = 16


class _Write(NamedTuple):
    record: Incoming | WorkResult
    size: int
    future: Future[Any]


class GroupCommit:
    """Writer for many threads.

    A future is resolved when its transaction is on the disk. If the transaction fails, all its futures get
    StoreUnavailable, and the thread continues with the next writes. A write that is invalid by itself (a result that
    covers a message of another lease) fails alone, and so do those of a servo that is set aside: the others are
    committed without them.

    Parameters
    ----------
    store : Store
    limits : CommitLimits
    clock : callable
        s since the epoch.
    """

    def __init__(
        self,
        store: Store,
        limits: CommitLimits | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._store, self._limits, self._clock = store, limits or CommitLimits(), clock
        self._jobs: deque[_Write] = deque()
        self._messages = self._bytes = 0
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="group commit", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of messages and results that wait for a transaction."""
        return len(self._jobs)

    def put(self, item: Incoming) -> Future[PutResult]:
        """Store a message.

        Raises
        ------
        StoreBusy
            The queue is full: try again later.
        StoreUnavailable
            It is closed.
        """
        size = len(item.body)
        with self._changed:
            # Refused rather than queued without bound: the edge has the message on its disk and repeats it.
            if self._messages >= self._limits.waiting or self._bytes + size > self._limits.waiting_bytes:
                raise StoreBusy(f"store {self._store.name}: {self._messages} messages wait to be committed; try later")
            future: Future[PutResult] = self._enqueue(item, size)
            self._messages, self._bytes = self._messages + 1, self._bytes + size
        return future

    def commit(self, result: WorkResult) -> Future[bool]:
        """Commit a work result; False: it is void, as another result of the servo was committed before it.

        Raises
        ------
        StoreUnavailable
            It is closed.
        """
        with self._changed:
            return self._enqueue(result, sum(map(len, result.outgoing)))

    def close(self) -> None:
        """Accept nothing more, commit the waiting writes, end the thread; the store stays open."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _enqueue(self, record: Incoming | WorkResult, size: int) -> Future[Any]:
        if self._closing:
            raise StoreUnavailable(f"store {self._store.name}: is being closed")
        future: Future[Any] = Future()
        # From here on the future cannot be cancelled: the write will be done.
        future.set_running_or_notify_cancel()
        self._jobs.append(_Write(record, size, future))
        if len(self._jobs) in (1, self._limits.enough):  # what the thread may wait for
            self._changed.notify()
        return future

    def _run(self) -> None:
        while jobs := self._take():
            self._write(jobs)

    def _take(self) -> list[_Write]:
        """Wait for the writes of the next transaction; none: closed, and all is written."""
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._closing)
            if self._limits.gather:
                enough = self._limits.enough
                self._changed.wait_for(lambda: self._closing or len(self._jobs) >= enough, self._limits.gather)
            batch: list[_Write] = []
            size = 0
            while self._jobs and len(batch) < self._limits.together and size < self._limits.together_bytes:
                job = self._jobs.popleft()
                batch.append(job)
                size += job.size
                if isinstance(job.record, Incoming):
                    self._messages, self._bytes = self._messages - 1, self._bytes - job.size
        return batch

    def _write(self, jobs: Sequence[_Write]) -> None:
        try:
            self._commit(jobs)
        except ServoSetAside as error:
            others = [job for job in jobs if job.record.servo != error.servo]
            if len(others) == len(jobs):
                _fail(jobs, error)
                return
            _fail([job for job in jobs if job.record.servo == error.servo], error)
            if others:
                self._write(others)
        except StoreUnavailable as error:
            _fail(jobs, error)
        except Exception as error:
            if len(jobs) == 1:
                _fail(jobs, error)
                return
            # One write is invalid: each gets a transaction of its own, so that only that one fails.
            for job in jobs:
                self._write([job])

    def _commit(self, jobs: Sequence[_Write]) -> None:
        puts = [(job.record, job.future) for job in jobs if isinstance(job.record, Incoming)]
        commits = [(job.record, job.future) for job in jobs if isinstance(job.record, WorkResult)]
        items, results = [item for item, _ in puts], [result for result, _ in commits]
        stored, valid = self._store.write(items, results, self._clock())
        _resolve([future for _, future in puts], stored)
        _resolve([future for _, future in commits], valid)


class _Failure(NamedTuple):
    at: float
    why: str


_NEVER = _Failure(-math.inf, "")
_OUTDATED_S = 60.0
"""s after which the failure of a result says nothing where other writes succeed: another process did that work."""


class AwaitedCommits:
    """Writes of a group commit for an event loop, which awaits them.

    Unlike asyncio.wrap_future this wakes the loop once for all futures that one commit resolves.

    Parameters
    ----------
    commits : GroupCommit
    clock : callable
        Monotonic seconds.

    """

    def __init__(self, commits: GroupCommit, clock: Callable[[], float] = time.monotonic) -> None:
        self._commits, self._clock = commits, clock
        self._done: deque[tuple[asyncio.Future[Any], Future[Any]]] = deque()
        self._begun = dict[object, float]()
        # Apart: where only results cannot be written, as without a right on their tables, messages come every second.
        self._failed = {Incoming: _NEVER, WorkResult: _NEVER}

    @property
    def failed_at(self) -> float:
        """Time of the last failure, on `clock`; -inf: the last message and the last result were written."""
        return max(self._failed.values()).at

    @property
    def failure(self) -> str:
        """Reason of that failure."""
        return max(self._failed.values()).why

    @property
    def waited(self) -> float:
        """Time for which the oldest write in progress has waited for its commit, s."""
        return self._clock() - min(self._begun.values()) if self._begun else 0.0

    async def put(self, item: Incoming) -> PutResult:
        """Store a message; returns when it is on the disk. Raises as `GroupCommit.put` and its future do."""
        return await self._result(self._commits.put, item)

    async def commit(self, result: WorkResult) -> bool:
        """Commit a work result; False: it is void. Raises as `GroupCommit.commit` and its future do."""
        return await self._result(self._commits.commit, result)

    async def _result(self, write: Callable[[_Record], Future[_Result]], record: _Record) -> _Result:
        mark = object()
        self._begun[mark] = self._clock()
        try:
            result = await self._wrap(write(record))
        except ServoSetAside:
            raise  # the store itself works
        except StoreUnavailable as error:
            self._failed[type(record)] = _Failure(self._clock(), str(error))
            raise
        finally:
            del self._begun[mark]
        self._failed[type(record)] = _NEVER
        if self._failed[WorkResult].at < self._clock() - _OUTDATED_S:
            self._failed[WorkResult] = _NEVER
        return result

    def _wrap(self, future: Future[_Result]) -> asyncio.Future[_Result]:
        """Return a future of the running loop with the same result."""
        loop = asyncio.get_running_loop()
        wrapped: asyncio.Future[_Result] = loop.create_future()

        def on_done(done: Future[_Result]) -> None:
            # Appended first: either it is the only one and wakes the loop, or a wake-up is still to come.
            self._done.append((wrapped, done))
            if len(self._done) == 1:
                loop.call_soon_threadsafe(self._resolve)

        future.add_done_callback(on_done)
        return wrapped

    def _resolve(self) -> None:
        while self._done:
            wrapped, done = self._done.popleft()
            if wrapped.done():
                continue
            error = done.exception()
            if error is None:
                wrapped.set_result(done.result())
            else:
                wrapped.set_exception(error)


def _resolve(futures: Sequence[Future[Any]], results: Sequence[object]) -> None:
    for future, result in zip(futures, results, strict=True):
        future.set_result(result)


def _fail(jobs: Sequence[_Write], error: Exception) -> None:
    for job in jobs:
        job.future.set_exception(error)
