"""A process that is kept running: started in a group of its own, read, ended, started again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from servotwin.errors import InvalidInput

MOST, WITHIN_S = 5, 60.0
"""A process that ends by itself that often within that time is given up."""


class Child:
    """One process.

    Parameters
    ----------
    name : str
        For people.
    command : sequence of str
        A module and its arguments.
    log : Path
        What it says is put at its end.
    ready : str
        How the line begins with which it says that it is; empty: it says nothing.
    lock : int
        A descriptor that it keeps open.

    Attributes
    ----------
    told : str or None
        The rest of that line; None: it has not come yet.
    restarts : int
    """

    def __init__(self, name: str, command: Sequence[str], log: Path, ready: str, lock: int) -> None:
        self.name, self.command, self.log = name, tuple(command), log
        self.told: str | None = None
        self.restarts = 0
        self._ready, self._lock = ready, lock
        self._process: subprocess.Popen[bytes] | None = None
        self._output: IO[bytes] | None = None
        self._heard = b""
        self._ends: deque[float] = deque(maxlen=MOST)

    @property
    def pid(self) -> int | None:
        """Its process id, and that of its group; None: there is no process."""
        return None if self._process is None else self._process.pid

    @property
    def code(self) -> int | None:
        """How it ended; None: it runs."""
        return None if self._process is None else self._process.poll()

    def begin(self) -> None:
        """Start it; its standard input is a pipe that closes with this process."""
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "servotwin.up.attended", *self.command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
                pass_fds=(self._lock,),
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._heard = b""

    def hear(self) -> None:
        """Read what it has printed."""
        if self._process is None or self._process.stdout is None:
            return
        while data := self._process.stdout.read(65536):
            self._heard = (self._heard + data)[-65536:]
        *lines, self._heard = self._heard.split(b"\n")
        for line in lines:
            text = line.decode("utf-8", "replace")
            if self._ready and text.startswith(self._ready):
                self.told = text.removeprefix(self._ready).strip()

    def again(self, now: float) -> None:
        """Start it once more after it ended by itself.

        Raises
        ------
        InvalidInput
            That happens too often.
        """
        self._ends.append(now)
        if len(self._ends) == MOST and now - self._ends[0] < WITHIN_S:
            raise self.failed(f"ended {MOST} times within {now - self._ends[0]:.0f} s")
        self.release()
        self.restarts += 1
        self.begin()

    def failed(self, what: str) -> InvalidInput:
        """What to raise where it is of no use, with its last words."""
        words = last_line(self.log)
        return InvalidInput(f"{self.name} {what}{f': {words}' if words else ''} (see {self.log})")

    def ask(self) -> None:
        """Tell it to end."""
        if self._process is not None and self.code is None:
            self._process.terminate()

    def kill(self) -> None:
        """End it and all its group at once."""
        if self._process is not None and self._process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def release(self) -> None:
        """Close the pipes of one that has ended."""
        if self._process is not None:
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()
            self._process = None


def last_line(log: Path) -> str:
    """Of a file, if there is one, at most 300 characters."""
    with suppress(OSError), log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - 4096))
        lines = [line.strip() for line in file.read().decode("utf-8", "replace").splitlines() if line.strip()]
        return lines[-1][-300:] if lines else ""
    return ""
