"""Worker process, and the frames (`runtime.frames`) of MessagePack that it exchanges with the service; no pickles.

Started as `python -m servotwin.twin_service.worker DESCRIPTOR`. It works on what it receives over that one socket and
ends when the socket closes. It has no access to the store and keeps nothing but caches.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec

from servotwin.runtime.frames import frame, read_frame
from servotwin.store.records import Lease, WorkResult


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


class WorkerJob(NamedTuple):
    """Leases to be processed in order; `now` in s: since the epoch, or sample time in lock-step."""

    leases: tuple[Lease, ...]
    now: float


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
Work = Callable[[Lease, float], WorkResult]


def encode_frame(message: WorkerStart | WorkerJob | LeaseResult) -> bytes:
    """Frame of a message."""
    return frame(_encoder.encode(message))


def main(descriptor: int) -> None:
    """Process jobs until the socket closes."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the service ends its workers by closing the socket
    with socket.socket(fileno=descriptor) as line, line.makefile("rb") as stream:
        start = read_frame(stream)
        if start is None:
            return
        work = _load_work(start)
        # Empty: the imports are done, and the worker is ready for a job.
        line.sendall(frame(b""))
        while (body := read_frame(stream)) is not None:
            job = _decode_job(body)
            for lease in job.leases:
                # Each result at once: a lease that kills the worker must not take the results before it along.
                line.sendall(encode_frame(_attempt(work, lease, job.now)))


def _attempt(work: Work, lease: Lease, now: float) -> LeaseResult:
    """Process a lease; an exception becomes the result's error."""
    begun = time.perf_counter()
    result, error = None, ""
    try:
        result = work(lease, now)
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    return LeaseResult(result, error, time.perf_counter() - begun)


def _load_work(start: bytes) -> Work:
    from servotwin.twin.model_registry import ModelRegistry
    from servotwin.twin.work import work

    file = _decode_start(start)
    registry = ModelRegistry.loads(file.text, file.source, Path(file.folder))
    return lambda lease, now: work(registry, lease, now)


if __name__ == "__main__":
    # One thread each: the workers share the cores already.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        main(int(sys.argv[1]))
    except (BrokenPipeError, ConnectionResetError):
        sys.exit(0)
