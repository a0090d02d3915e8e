"""Many small writes in few transactions: one thread takes whatever waits, commits it together, then answers."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

from servotwin.store.errors import StoreBusy, StoreUnavailable
from servotwin.store.rows import Incoming, Outcome, Put
from servotwin.store.store import Store


class Bounds(NamedTuple):
    """How much may wait, and how much one transaction takes.

    Attributes
    ----------
    waiting, waiting_bytes : int
        Messages, and bytes of their bodies, that may wait; beyond it more are refused. Outcomes are not: there are no
        more of them than servos lent.
    together, together_bytes : int
        Messages and outcomes in one transaction, and bytes of bodies.
    """

    waiting: int = 4096
    waiting_bytes: int = 128 * 1024 * 1024
    together: int = 256
    together_bytes: int = 8 * 1024 * 1024


class _Job(NamedTuple):
    what: Incoming | Outcome
    size: int
    future: Future[Any]


class GroupCommit:
    """Writes for many threads.

    A future is resolved when its transaction is on the disk. If that fails, the futures of everything in it get
    StoreUnavailable, and the thread goes on with what came meanwhile. What is wrong in itself (an outcome for a message
    that it was not lent) fails alone: the others are committed without it.

    Parameters
    ----------
    store : Store
    bounds : Bounds
    clock : callable
        s since the epoch.
    """

    def __init__(self, store: Store, bounds: Bounds | None = None, clock: Callable[[], float] = time.time) -> None:
        self._store, self._bounds, self._clock = store, bounds or Bounds(), clock
        self._jobs: deque[_Job] = deque()
        self._messages = self._bytes = 0
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="group commit", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Messages and outcomes that wait for a transaction."""
        return len(self._jobs)

    def put(self, item: Incoming) -> Future[Put]:
        """Keep a message.

        Raises
        ------
        StoreBusy
            Too much waits already: try again later.
        StoreUnavailable
            It is closed.
        """
        size = len(item.body)
        with self._changed:
            if self._messages >= self._bounds.waiting or self._bytes + size > self._bounds.waiting_bytes:
                raise StoreBusy(f"store {self._store.name}: {self._messages} messages wait to be committed; try later")
            future: Future[Put] = self._queued(item, size)
            self._messages, self._bytes = self._messages + 1, self._bytes + size
        return future

    def commit(self, outcome: Outcome) -> Future[bool]:
        """Commit an outcome; whether it was valid, or void for another one before it.

        Raises
        ------
        StoreUnavailable
            It is closed.
        """
        with self._changed:
            return self._queued(outcome, sum(map(len, outcome.outgoing)))

    def close(self) -> None:
        """Take nothing more, commit what waits, end the thread; the store stays open."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _queued(self, what: Incoming | Outcome, size: int) -> Future[Any]:
        if self._closing:
            raise StoreUnavailable(f"store {self._store.name}: is being closed")
        future: Future[Any] = Future()
        # From here on nobody can cancel it: what was handed over will be written.
        future.set_running_or_notify_cancel()
        self._jobs.append(_Job(what, size, future))
        self._changed.notify()
        return future

    def _run(self) -> None:
        while jobs := self._take():
            self._write(jobs)

    def _take(self) -> list[_Job]:
        """What goes into the next transaction; nothing: it is closed and all is written."""
        taken: list[_Job] = []
        size = 0
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._closing)
            while self._jobs and len(taken) < self._bounds.together and size < self._bounds.together_bytes:
                job = self._jobs.popleft()
                taken.append(job)
                size += job.size
                if isinstance(job.what, Incoming):
                    self._messages, self._bytes = self._messages - 1, self._bytes - job.size
        return taken

    def _write(self, jobs: Sequence[_Job]) -> None:
        try:
            self._commit(jobs)
        except StoreUnavailable as error:
            _fail(jobs, error)
        except Exception as error:
            if len(jobs) == 1:
                _fail(jobs, error)
                return
            for job in jobs:
                self._write([job])

    def _commit(self, jobs: Sequence[_Job]) -> None:
        puts = [(job.what, job.future) for job in jobs if isinstance(job.what, Incoming)]
        commits = [(job.what, job.future) for job in jobs if isinstance(job.what, Outcome)]
        items, outcomes = [item for item, _ in puts], [outcome for outcome, _ in commits]
        became, valid = self._store.write(items, outcomes, self._clock())
        _resolve([future for _, future in puts], became)
        _resolve([future for _, future in commits], valid)


def _resolve(futures: Sequence[Future[Any]], answers: Sequence[object]) -> None:
    for future, answer in zip(futures, answers, strict=True):
        future.set_result(answer)


def _fail(jobs: Sequence[_Job], error: Exception) -> None:
    for job in jobs:
        job.future.set_exception(error)
