"""Worker processes: asked over sockets, replaced when they die or hang."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import sys
from collections.abc import AsyncIterator, Mapping, Sequence
from functools import partial

from servotwin.runtime.child_process import ChildProcess
from servotwin.runtime.frames import receive_frame
from servotwin.runtime.retry import Backoff, Retry
from servotwin.store.records import Lease
from servotwin.twin_service import config
from servotwin.twin_service.job import Done, Job, Start, done_of, framed

log = logging.getLogger(__name__)

BEGIN_S = 120.0
"""s that a worker may take until it listens: it imports and compiles."""
END_S = 5.0
COMMAND = (sys.executable, "-m", "servotwin.twin_service.worker")


class WorkerLost(Exception):
    """A worker died or hung; what it was asked for may be asked again."""


class Worker:
    """One process.

    Parameters
    ----------
    start : Start
    timeout : float
        s that it may take over one claim.
    command : sequence of str
        What is run, with the number of a descriptor behind it.
    """

    def __init__(self, start: Start, timeout: float, command: Sequence[str] = COMMAND) -> None:
        self._start, self._timeout, self._command = start, timeout, tuple(command)
        self._process: ChildProcess | None = None
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    @property
    def pid(self) -> int | None:
        """Of the process, while there is one."""
        return None if self._process is None or self._process.code is not None else self._process.pid

    async def begin(self) -> None:
        """Start the process and wait until it listens; raises WorkerLost."""
        ours, theirs = socket.socketpair()
        with theirs:
            number = theirs.fileno()
            self._process = ChildProcess((*self._command, str(number)), pass_fds=(number,), env=_environment())
        self._reader, self._writer = await asyncio.open_connection(sock=ours)
        self._send(framed(self._start))
        await self._frame(BEGIN_S)

    async def work(self, claims: Sequence[Lease], now: float) -> AsyncIterator[Done]:
        """What becomes of each claim, one after the other; raises WorkerLost."""
        self._send(framed(Job(tuple(claims), now)))
        for _ in claims:
            yield done_of(await self._frame(self._timeout))

    async def end(self) -> None:
        """Close the socket, and see the process gone."""
        if self._writer is not None:
            self._writer.close()
        if self._process is not None:
            await asyncio.to_thread(self._process.wait, END_S)

    async def kill(self) -> None:
        """End it at once."""
        if self._writer is not None:
            self._writer.close()
        if self._process is not None:
            self._process.kill()
            await asyncio.to_thread(self._process.wait, END_S)

    def _send(self, frame: bytes) -> None:
        if self._writer is None or self._writer.is_closing():
            raise WorkerLost("the worker is gone")
        self._writer.write(frame)

    async def _frame(self, timeout: float) -> bytes:
        assert self._reader is not None
        try:
            async with asyncio.timeout(timeout):
                return await receive_frame(self._reader)
        except TimeoutError:
            raise WorkerLost(f"the worker did not answer within {timeout:g} s") from None
        except (asyncio.IncompleteReadError, OSError):
            raise WorkerLost("the worker ended") from None


class Pool:
    """Some workers, each lent to one task at a time.

    Parameters
    ----------
    size : int
    start : Start
    timeout : float
        s for one claim.
    command : sequence of str
    """

    def __init__(self, size: int, start: Start, timeout: float, command: Sequence[str] = COMMAND) -> None:
        self.size, self.lost = size, 0
        self._make = partial(Worker, start, timeout, command)
        self._workers: set[Worker] = set()
        self._idle: asyncio.Queue[Worker] = asyncio.Queue()

    @property
    def alive(self) -> int:
        """Workers whose process runs."""
        return sum(worker.pid is not None for worker in self._workers)

    async def begin(self) -> None:
        """Start all workers.

        Raises
        ------
        WorkerLost
            One could not be started; none is left.
        """
        self._workers = {self._make() for _ in range(self.size)}
        try:
            await asyncio.gather(*(worker.begin() for worker in self._workers))
        except WorkerLost:
            await self.end()
            raise
        for worker in self._workers:
            self._idle.put_nowait(worker)

    async def lend(self) -> Worker:
        """A worker that has nothing to do, as soon as there is one."""
        return await self._idle.get()

    def take_back(self, worker: Worker) -> None:
        """It has done what it was lent for."""
        self._idle.put_nowait(worker)

    async def replace(self, worker: Worker, why: str) -> None:
        """Put another one into the place of a worker that is of no more use."""
        log.warning("worker replaced", extra={"pid": worker.pid, "why": why})
        self.lost += 1
        self._workers.discard(worker)
        await worker.kill()
        backoff = Backoff(Retry(0.1, 2.0, 30.0))
        while True:
            fresh = self._make()
            self._workers.add(fresh)
            try:
                await fresh.begin()
            except (WorkerLost, OSError) as error:
                self._workers.discard(fresh)
                await fresh.kill()
                log.error("worker does not start", extra={"why": str(error)})
                await asyncio.sleep(backoff.failed())
                continue
            self._idle.put_nowait(fresh)
            return

    async def end(self) -> None:
        """End all workers."""
        await asyncio.gather(*(worker.end() for worker in self._workers))
        self._workers.clear()


def _environment() -> Mapping[str, str]:
    """The service's, without what no worker has to know."""
    secret = config.PASSWORD, config.MQTT_PASSWORD
    mine = {key: value for key, value in os.environ.items() if key not in secret}
    return {**mine, "OPENBLAS_NUM_THREADS": "1"}
