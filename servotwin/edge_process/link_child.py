"""The link process as a child of the control process, which starts it, and restarts it when it has ended."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from pathlib import Path

from servotwin.edge_process.monitoring import log
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.runtime.child_process import ChildProcess
from servotwin.runtime.frames import FrameSocket
from servotwin.runtime.retry import Backoff, Retry

Start = Callable[[socket.socket], ChildProcess]
_END_S = 10.0


def link_command(file: Path, run: str, samples: int | None = None) -> Start:
    """Return a function that starts a link process; no argument is secret.

    Parameters
    ----------
    file : Path
        The `edge.toml`.
    run : str
        Run of the edge.
    samples : int, optional
        Descriptor of the memory with the samples, for the live view.
    """
    shared = () if samples is None else (samples,)

    def start(end: socket.socket) -> ChildProcess:
        command = [sys.executable, "-m", "servotwin.edge_process.link_process", str(file), str(end.fileno()), run]
        return ChildProcess([*command, *map(str, shared)], pass_fds=(end.fileno(), *shared))

    return start


class LinkChild:
    """Keeps a link process running.

    Parameters
    ----------
    start : callable
        Starts a process that communicates over a socket.
    outlet : PipeOutlet
    """

    def __init__(self, start: Start, outlet: PipeOutlet) -> None:
        self._start, self._outlet = start, outlet
        self._process: ChildProcess | None = None
        self._backoff = Backoff(Retry(0.5, 2.0, 10.0))
        self._started = self._due = 0.0
        self.starts = 0

    @property
    def pid(self) -> int | None:
        """Process id; None: it does not run."""
        return None if self._process is None else self._process.pid

    def check(self, now: float) -> None:
        """Start it where a start is due; detect that it has ended. Costs microseconds while it runs."""
        if self._process is None:
            if now >= self._due:
                self._launch(now)
            return
        code = self._process.code
        if code is None and self._outlet.connected:
            return
        if code is None:
            # It runs without a connection and is of no use any more: the next check starts another.
            self._process.kill()
            return
        log("link process gone", code=code)
        self._ended(now)

    def close(self) -> None:
        """Close the connection, so that it finishes its work, and wait for its end."""
        self._outlet.disconnect()
        if self._process is not None:
            self._process.wait(_END_S)
        self._process = None

    def _launch(self, now: float) -> None:
        ours, theirs = socket.socketpair()
        try:
            self._process = self._start(theirs)
        except OSError as error:
            ours.close()
            log("link process not started", error=str(error))
            self._ended(now)
            return
        finally:
            # The child has its own copy: with this one open, its end would not close the connection.
            theirs.close()
        self.starts += 1
        self._started = now
        self._outlet.connect(FrameSocket(ours))

    def _ended(self, now: float) -> None:
        """Schedule the restart: soon after a run of some time, later and later where it keeps ending."""
        self._outlet.disconnect()
        self._process = None
        if now - self._started > 10.0:
            self._backoff.succeeded()
        self._due = now + self._backoff.failed(0.0)
