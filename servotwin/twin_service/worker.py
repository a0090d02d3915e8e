"""Worker processes: their pool in the service, which replaces those that die or hang, and the process itself.

Both ends exchange frames (`runtime.frames`) of MessagePack over a socket; no pickles. A worker is started as
`python -m servotwin.twin_service.worker DESCRIPTOR`. It works on what it receives over that one socket and ends when
the socket closes. It has no access to the store and keeps nothing but caches.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec

from servotwin.errors import InvalidInput
from servotwin.runtime.child_process import ChildProcess
from servotwin.runtime.frames import frame, read_frame, receive_frame
from servotwin.runtime.retry import Backoff, Retry
from servotwin.store.records import Lease, WorkResult
from servotwin.twin_service import config

log = logging.getLogger(__name__)

_START_S = 120.0
"""s that a worker may take until it is ready: it imports and compiles."""
_START_TRIES = 3
"""Times that a worker is started before the service gives up its own start."""
_STOP_S = 5.0
_COMMAND = (sys.executable, "-m", "servotwin.twin_service.worker")


class WorkerStart(NamedTuple):
    """First message to a worker.

    Attributes
    ----------
    text : str
        Text of the twin's file.
    source, folder : str
        Its name in messages; the folder that its relative paths start from.
    """

    text: str
    source: str
    folder: str


WorkerUrgency = tuple[float, float, bool]
"""Fields of `twin.work.Urgency`."""


class WorkerJob(NamedTuple):
    """Leases to be processed in order.

    Attributes
    ----------
    leases : tuple of Lease
    now : float
        s: since the epoch, or sample time in lock-step.
    urgency : (float, float, bool), optional
        Fields of `twin.work.Urgency`; the time then runs on from `now`. None: in lock-step.
    """

    leases: tuple[Lease, ...]
    now: float
    urgency: WorkerUrgency | None = None


class LeaseResult(NamedTuple):
    """Result of one lease.

    Attributes
    ----------
    result : WorkResult or None
    error : str
        Why there is none.
    seconds : float
        Time that it took.
    """

    result: WorkResult | None
    error: str
    seconds: float


_encoder = msgspec.msgpack.Encoder()
_decode_start = msgspec.msgpack.Decoder(WorkerStart).decode
_decode_job = msgspec.msgpack.Decoder(WorkerJob).decode
decode_result = msgspec.msgpack.Decoder(LeaseResult).decode
Work = Callable[[Lease, float, WorkerUrgency | None], WorkResult]


def encode_frame(message: WorkerStart | WorkerJob | LeaseResult) -> bytes:
    """Frame of a message."""
    return frame(_encoder.encode(message))


class WorkerLost(Exception):
    """A worker died or hung; its job may be repeated."""


class WorkerProcess:
    """One worker.

    Parameters
    ----------
    start : WorkerStart
    timeout : float
        s that it may take for one lease.
    command : sequence of str
        Command line; the number of the socket's descriptor is appended.
    """

    def __init__(self, start: WorkerStart, timeout: float, command: Sequence[str] = _COMMAND) -> None:
        self._start, self._timeout, self._command = start, timeout, tuple(command)
        self._process: ChildProcess | None = None
        self._socket: socket.socket | None = None
        self._ready = False
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    @property
    def pid(self) -> int | None:
        """Process id, while the process runs."""
        return None if self._process is None or self._process.code is not None else self._process.pid

    def launch(self) -> None:
        """Start the process, without waiting until it is ready."""
        self._socket, theirs = socket.socketpair()
        # Closed here once the child has a copy: only then does the end of the child close the connection.
        with theirs:
            number = theirs.fileno()
            self._process = ChildProcess((*self._command, str(number)), pass_fds=(number,), env=_environment())

    def check(self) -> None:
        """Wait until the launched process is ready, without an event loop; `start` reports one that is not.

        Raises
        ------
        InvalidInput
            The worker refuses the twin's file.
        """
        assert self._socket is not None
        self._socket.settimeout(_START_S)
        try:
            self._socket.sendall(encode_frame(self._start))
            with self._socket.makefile("rb") as stream:
                answer = read_frame(stream)
        except OSError:
            answer = None
        if answer is None:
            self.discard()
        elif answer:
            raise InvalidInput(answer.decode())
        else:
            self._ready = True

    async def start(self) -> None:
        """Start the process, unless it was launched, and wait until it is ready; raises WorkerLost."""
        if self._socket is None:
            self.launch()
        if self._socket is None or self._socket.fileno() < 0:
            raise WorkerLost("the worker ended")
        self._reader, self._writer = await asyncio.open_connection(sock=self._socket)
        if not self._ready:
            self._send(encode_frame(self._start))
            if refusal := await self._receive(_START_S):
                raise WorkerLost(refusal.decode())

    async def work(
        self, leases: Sequence[Lease], now: float, urgency: WorkerUrgency | None = None
    ) -> AsyncIterator[LeaseResult]:
        """Process leases, as `WorkerJob` has them; yields their results in order. Raises WorkerLost."""
        self._send(encode_frame(WorkerJob(tuple(leases), now, urgency)))
        # One timeout per lease, not per job: a job may hold sixteen of them.
        for _ in leases:
            yield decode_result(await self._receive(self._timeout))

    async def ask(self, question: bytes) -> bytes:
        """Send a frame and return the body of the next one, where the command line is not a worker's; or WorkerLost."""
        self._send(frame(question))
        return await self._receive(self._timeout)

    async def stop(self) -> None:
        """Close the socket and wait for the end of the process."""
        if self._writer is not None:
            self._writer.close()
        if self._process is not None:
            await asyncio.to_thread(self._process.wait, _STOP_S)

    async def kill(self) -> None:
        """Kill the process."""
        if self._writer is not None:
            self._writer.close()
        if self._process is not None:
            self._process.kill()
            await asyncio.to_thread(self._process.wait, _STOP_S)

    def discard(self) -> None:
        """Close the socket and kill the process, without an event loop; does nothing to one that was stopped."""
        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait(_STOP_S)

    def _send(self, data: bytes) -> None:
        if self._writer is None or self._writer.is_closing():
            raise WorkerLost("the socket to the worker is closed")
        self._writer.write(data)

    async def _receive(self, timeout: float) -> bytes:
        assert self._reader is not None
        try:
            async with asyncio.timeout(timeout):
                return await receive_frame(self._reader)
        except TimeoutError:
            raise WorkerLost(f"the worker did not answer within {timeout:g} s") from None
        except (asyncio.IncompleteReadError, OSError):
            raise WorkerLost("the worker ended") from None


class WorkerPool:
    """Workers, each used by one task at a time.

    Parameters
    ----------
    size : int
    start : WorkerStart
    timeout : float
        s for one lease.
    command : sequence of str

    Attributes
    ----------
    lost : int
        Number of workers that were replaced.
    """

    def __init__(self, size: int, start: WorkerStart, timeout: float, command: Sequence[str] = _COMMAND) -> None:
        self.size, self.lost = size, 0
        self._make = partial(WorkerProcess, start, timeout, command)
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

    async def stop(self) -> None:
        """Stop all workers."""
        await asyncio.gather(*(worker.stop() for worker in self._workers))
        self._workers.clear()


def _environment() -> Mapping[str, str]:
    """Environment of a worker: the service's without its passwords."""
    secrets = config.PASSWORD, config.MQTT_PASSWORD
    passed = {key: value for key, value in os.environ.items() if key not in secrets}
    # One thread each: the workers share the cores already.
    return {**passed, "OPENBLAS_NUM_THREADS": "1"}


def main(descriptor: int) -> None:
    """Process jobs until the socket closes."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the service ends its workers by closing the socket
    with socket.socket(fileno=descriptor) as line, line.makefile("rb") as stream:
        start = read_frame(stream)
        if start is None:
            return
        try:
            work = _load_work(start)
        except InvalidInput as refusal:
            line.sendall(frame(str(refusal).encode()))
            return
        # Empty: the imports are done, and the worker is ready for a job.
        line.sendall(frame(b""))
        while (body := read_frame(stream)) is not None:
            job, begun = _decode_job(body), time.monotonic()
            for lease in job.leases:
                # The leases before this one took their time; in lock-step no time passes.
                now = job.now if job.urgency is None else job.now + time.monotonic() - begun
                # Each result at once: a lease that kills the worker must not take the results before it along.
                line.sendall(encode_frame(_attempt(work, lease, now, job.urgency)))


def _attempt(work: Work, lease: Lease, now: float, urgency: WorkerUrgency | None) -> LeaseResult:
    """Process a lease; an exception becomes the result's error."""
    begun = time.perf_counter()
    result, error = None, ""
    try:
        result = work(lease, now, urgency)
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    return LeaseResult(result, error, time.perf_counter() - begun)


def _load_work(start: bytes) -> Work:
    from servotwin.twin.model_registry import ModelRegistry
    from servotwin.twin.work import Urgency, work

    file = _decode_start(start)
    registry = ModelRegistry.loads(file.text, file.source, Path(file.folder))
    return lambda lease, now, urgency: work(registry, lease, now, None if urgency is None else Urgency(*urgency))


if __name__ == "__main__":
    # One thread each: the workers share the cores already.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        main(int(sys.argv[1]))
    except (BrokenPipeError, ConnectionResetError):
        sys.exit(0)
