"""A worker: a process that does what it is asked over one socket, and ends when that closes.

Started as `python -m servotwin.twin_service.worker DESCRIPTOR`. It has no access to the store and keeps nothing but
caches.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

from servotwin.runtime.frames import frame, read_frame
from servotwin.store.records import Lease, WorkResult
from servotwin.twin_service.job import Done, framed, job_of, start_of

Work = Callable[[Lease, float], WorkResult]


def main(descriptor: int) -> None:
    """Work until nobody asks any more."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the service ends its workers: by closing the socket
    with socket.socket(fileno=descriptor) as line, line.makefile("rb") as incoming:
        start = read_frame(incoming)
        if start is None:
            return
        work = _work_of(start)
        line.sendall(frame(b""))
        while (body := read_frame(incoming)) is not None:
            job = job_of(body)
            for claim in job.claims:
                line.sendall(framed(attempt(work, claim, job.now)))


def attempt(work: Work, claim: Lease, now: float) -> Done:
    """Do it, whatever happens: an error is told, not raised."""
    begun = time.perf_counter()
    try:
        outcome, error = work(claim, now), ""
    except Exception as failure:
        outcome, error = None, f"{type(failure).__name__}: {failure}"
    return Done(outcome, error, time.perf_counter() - begun)


def _work_of(start: bytes) -> Work:
    from servotwin.twin.fleet import Fleet
    from servotwin.twin.work import work

    given = start_of(start)
    fleet = Fleet.loads(given.text, given.source, Path(given.folder))
    return lambda claim, now: work(fleet, claim, now)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        main(int(sys.argv[1]))
    except (BrokenPipeError, ConnectionResetError):
        sys.exit(0)
