"""Pool of worker processes in the service, which replaces those that die or hang."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from servotwin.runtime.retry import Backoff, Retry
from servotwin.twin_service.twin_file import TwinFile
from servotwin.twin_service.worker import COMMAND, WorkerLost, WorkerProcess, WorkerStart

log = logging.getLogger(__name__)

_START_TRIES = 3
"""Times that a worker is started before the service gives up its own start."""
_FINISH_S, _KILLED_S = 15.0, 5.0
"""s at the end for work that is running, and then for noting that its workers were killed."""
_MB = 1e6


def pool_of(twin: TwinFile) -> WorkerPool:
    """Make the pool that a twin's file states."""
    service = twin.service
    memory = service.worker_megabytes * _MB
    return WorkerPool(service.workers, twin.start, service.job_timeout_s, memory=memory)


class WorkerPool:
    """Workers, each used by one task at a time.

    Parameters
    ----------
    size : int
    start : WorkerStart
    timeout : float
        s for one lease.
    command : sequence of str
    memory : float
        Bytes of each.

    Attributes
    ----------
    lost : int
        Number of workers that were replaced.
    """

    def __init__(
        self,
        size: int,
        start: WorkerStart,
        timeout: float,
        command: Sequence[str] = COMMAND,
        memory: float = math.inf,
    ) -> None:
        self.size, self.lost = size, 0
        self._make = partial(WorkerProcess, start, timeout, command, memory)
        self._launched: list[WorkerProcess] = []
        self._workers: set[WorkerProcess] = set()
        self._idle: asyncio.Queue[WorkerProcess] = asyncio.Queue()

    @property
    def alive(self) -> int:
        """Number of workers whose process runs."""
        return sum(worker.pid is not None for worker in self._workers)

    @contextmanager
    def launched(self) -> Iterator[None]:
        """Launch all workers, have the first one check the twin's file, and kill in the end those that still run.

        Raises
        ------
        InvalidInput
            A worker refuses the file.
        """
        self._launched = [self._make() for _ in range(self.size)]
        try:
            for worker in self._launched:
                worker.launch()
            self._launched[0].check()
            yield
        finally:
            for worker in self._launched:
                worker.discard()

    async def start(self) -> None:
        """Start all workers; one that ends meanwhile is replaced, as it would be later.

        Raises
        ------
        WorkerLost
            A worker and those in its place did not start; the others were stopped.
        """
        self._workers = set(self._launched) or {self._make() for _ in range(self.size)}
        starts = [asyncio.ensure_future(self._start(worker)) for worker in list(self._workers)]
        try:
            await asyncio.gather(*starts)
        except WorkerLost:
            # Their workers end now, which they must not take for a death.
            for start in starts:
                start.cancel()
            await asyncio.gather(*starts, return_exceptions=True)
            await self.stop()
            raise
        for worker in self._workers:
            self._idle.put_nowait(worker)

    async def _start(self, worker: WorkerProcess) -> None:
        for tries_left in reversed(range(_START_TRIES)):
            try:
                await worker.start()
                return
            except WorkerLost as error:
                if not tries_left:
                    raise
                log.warning("worker replaced", extra={"pid": worker.pid, "why": str(error)})
            self.lost += 1
            self._workers.discard(worker)
            await worker.kill()
            worker = self._make()
            self._workers.add(worker)

    async def acquire(self) -> WorkerProcess:
        """Wait for an idle worker."""
        return await self._idle.get()

    def release(self, worker: WorkerProcess) -> None:
        """Return a worker to the pool."""
        self._idle.put_nowait(worker)

    async def replace(self, worker: WorkerProcess, why: str) -> None:
        """Kill a worker and start another one in its place."""
        log.warning("worker replaced", extra={"pid": worker.pid, "why": why})
        self.lost += 1
        self._workers.discard(worker)
        await worker.kill()
        # A worker that cannot start (no memory, a broken installation) must not keep the processor busy.
        backoff = Backoff(Retry(0.1, 2.0, 30.0))
        while True:
            fresh = self._make()
            self._workers.add(fresh)
            try:
                await fresh.start()
            except (WorkerLost, OSError) as error:
                self._workers.discard(fresh)
                await fresh.kill()
                log.error("worker does not start", extra={"why": str(error)})
                await asyncio.sleep(backoff.failed())
                continue
            self._idle.put_nowait(fresh)
            return

    async def finish(self, tasks: set[asyncio.Task[None]]) -> None:
        """Give tasks that use workers some time to end, and kill their workers then: their work is not committed.

        Parameters
        ----------
        tasks : set of Task
            Tasks leave it when they end.
        """
        if await _ended(tasks, _FINISH_S):
            return
        idle = {self._idle.get_nowait() for _ in range(self._idle.qsize())}
        busy = self._workers - idle
        log.warning("work not finished at the end: it is repeated", extra={"workers": len(busy)})
        await asyncio.gather(*(worker.kill() for worker in busy))
        if not await _ended(tasks, _KILLED_S):  # as where a worker that was lost before does not start again
            for task in tasks:
                task.cancel()

    async def stop(self) -> None:
        """Stop all workers."""
        await asyncio.gather(*(worker.stop() for worker in self._workers))
        self._workers.clear()


async def _ended(tasks: set[asyncio.Task[None]], seconds: float) -> bool:
    """Wait until a set of tasks is empty; False: it is not after that time."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while tasks:
                await asyncio.wait(tasks)
    return not tasks
