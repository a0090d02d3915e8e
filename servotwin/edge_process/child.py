"""The link process as the control process sees it: started, and started again when it is gone."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from pathlib import Path

from servotwin.edge_process.log import say
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.runtime.child_process import ChildProcess
from servotwin.runtime.frames import FrameSocket
from servotwin.runtime.retry import Backoff, Retry

Start = Callable[[socket.socket], ChildProcess]
_ENDING_S = 10.0


def starter(file: Path) -> Start:
    """How a link process for an `edge.toml` is started; no secret is in its arguments."""

    def start(end: socket.socket) -> ChildProcess:
        command = [sys.executable, "-m", "servotwin.edge_process.link_process", str(file), str(end.fileno())]
        return ChildProcess(command, pass_fds=(end.fileno(),))

    return start


class LinkChild:
    """Keeps a link process running.

    Parameters
    ----------
    start : callable
        Starts one that speaks over a socket.
    outlet : PipeOutlet
    """

    def __init__(self, start: Start, outlet: PipeOutlet) -> None:
        self._start, self._outlet = start, outlet
        self._process: ChildProcess | None = None
        self._pauses = Backoff(Retry(0.5, 2.0, 10.0))
        self._begun = self._due = 0.0
        self.starts = 0

    @property
    def number(self) -> int | None:
        """Its process id."""
        return None if self._process is None else self._process.pid

    def tend(self, now: float) -> None:
        """Start it when it is due; see whether it is still there. Costs microseconds when it is."""
        if self._process is None:
            if now >= self._due:
                self._launch(now)
            return
        code = self._process.code
        if code is None and self._outlet.connected:
            return
        if code is None:
            self._process.kill()
            return
        say("link process gone", code=code)
        self._gone(now)

    def close(self) -> None:
        """Let it finish what it has, and end."""
        self._outlet.disconnect()
        if self._process is not None:
            self._process.wait(_ENDING_S)
        self._process = None

    def _launch(self, now: float) -> None:
        ours, theirs = socket.socketpair()
        try:
            self._process = self._start(theirs)
        except OSError as error:
            ours.close()
            say("link process not started", error=str(error))
            self._gone(now)
            return
        finally:
            theirs.close()
        self.starts += 1
        self._begun = now
        self._outlet.connect(FrameSocket(ours))

    def _gone(self, now: float) -> None:
        """One that ran for a while is started again at once, one that keeps falling later and later."""
        self._outlet.disconnect()
        self._process = None
        if now - self._begun > 10.0:
            self._pauses.succeeded()
        self._due = now + self._pauses.failed(0.0)
