"""Worker processes: the end in the service, and the process itself.

Both ends exchange frames (`runtime.frames`) of MessagePack over a socket; no pickles. A worker is started as
`python -m servotwin.twin_service.worker DESCRIPTOR`. It works on what it receives over that one socket and ends when
the socket closes. It has no access to the store and keeps nothing but caches.
"""

from __future__ import annotations

import asyncio
import math
import os
import resource
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec

from servotwin.errors import InvalidInput
from servotwin.runtime.child_process import ChildProcess
from servotwin.runtime.frames import frame, read_frame, receive_frame
from servotwin.store.records import Lease, WorkResult
from servotwin.twin_service import config

_START_S = 120.0
"""s that a worker may take until it is ready: it imports and compiles."""
_STOP_S = 5.0
COMMAND = (sys.executable, "-m", "servotwin.twin_service.worker")


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


class StoreAddress(NamedTuple):
    """First message to a process that only reads the store; `url` may hold a password."""

    url: str


WorkerUrgency = tuple[float, float, bool, bool]
"""Fields of `twin.work.Urgency`."""


class WorkerJob(NamedTuple):
    """Leases to be processed in order.

    Attributes
    ----------
    leases : tuple of Lease
    now : float
        s: since the epoch, or sample time in lock-step.
    urgency : tuple of (float, float, bool, bool)
        Of each lease, the fields of `twin.work.Urgency`; the time then runs on from `now`. Empty: in lock-step.
    """

    leases: tuple[Lease, ...]
    now: float
    urgency: tuple[WorkerUrgency, ...] = ()


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


def encode_frame(message: WorkerStart | StoreAddress | WorkerJob | LeaseResult) -> bytes:
    """Frame of a message."""
    return frame(_encoder.encode(message))


class WorkerLost(Exception):
    """A worker died or hung; its job may be repeated."""


class WorkerProcess:
    """One worker.

    Parameters
    ----------
    start : WorkerStart or StoreAddress
    timeout : float
        s that it may take for one lease.
    command : sequence of str
        Command line; the number of the socket's descriptor is appended.
    memory : float
        Bytes of memory of its own that it may have. A message for which that is not enough fails.
    """

    def __init__(
        self,
        start: WorkerStart | StoreAddress,
        timeout: float,
        command: Sequence[str] = COMMAND,
        memory: float = math.inf,
    ) -> None:
        self._start, self._timeout, self._command, self._memory = start, timeout, tuple(command), memory
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
        _limit_memory(self._process.pid, self._memory)

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
        self, leases: Sequence[Lease], now: float, urgency: Sequence[WorkerUrgency] = ()
    ) -> AsyncIterator[LeaseResult]:
        """Process leases, as `WorkerJob` has them; yields their results in order. Raises WorkerLost."""
        self._send(encode_frame(WorkerJob(tuple(leases), now, tuple(urgency))))
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


def _limit_memory(pid: int, size: float) -> None:
    """Limit a process's own writable memory, where the system can."""
    if math.isfinite(size) and hasattr(resource, "prlimit"):
        with suppress(OSError):  # it has ended already
            resource.prlimit(pid, resource.RLIMIT_DATA, (int(size), int(size)))


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
            # Each result at once: a lease that kills the worker must not take the results before it along.
            for result in _results(work, _decode_job(body)):
                line.sendall(encode_frame(result))


def _results(work: Work, job: WorkerJob) -> Iterator[LeaseResult]:
    """Process the leases of a job in order."""
    begun, longest = time.monotonic(), 0.0
    for number, lease in enumerate(job.leases):
        now, urgency = job.now, None
        if job.urgency:  # otherwise, in lock-step, no time passes
            # The leases before this one took their time, and showed what the work takes now.
            now += time.monotonic() - begun
            urgency = (max(job.urgency[number][0], longest), *job.urgency[number][1:])
        result = _attempt(work, lease, now, urgency)
        longest = max(longest, result.seconds)
        yield result


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
