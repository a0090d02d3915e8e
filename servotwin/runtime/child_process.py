"""Child processes: start, watch and end one; keep one running, with its log.

`python -m servotwin.runtime.child_process MODULE ARGUMENTS` runs a module that ends when its standard input does. The
parent has the other end of that pipe and never writes to it: the system closes the pipe when the parent ends, even by
SIGKILL. The child then sends itself SIGTERM, and kills its process group if the module has not ended after `GRACE_S`.
"""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import IO

from servotwin.errors import InvalidInput

MOST_ENDS, WITHIN_S = 5, 60.0
"""A child that ends by itself `MOST_ENDS` times within `WITHIN_S` is not restarted again."""
GRACE_S = 15.0
"""Time that a module has to end after its parent has ended."""


class ChildProcess:
    """A process that was started.

    Parameters
    ----------
    command : sequence of str
    pass_fds : sequence of int
        Descriptors that it inherits.
    stdin, stdout, stderr : int or file, optional
        As `subprocess.Popen` takes them; its standard input is empty by default.
    env : mapping, optional
        Its environment; None: this process's.
    group : bool
        Start it in a session and process group of its own, which `kill` ends as a whole.

    Raises
    ------
    OSError
        The process cannot be started.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        pass_fds: Sequence[int] = (),
        stdin: int | IO[bytes] = subprocess.DEVNULL,
        stdout: int | IO[bytes] | None = None,
        stderr: int | IO[bytes] | None = None,
        env: Mapping[str, str] | None = None,
        group: bool = False,
    ) -> None:
        self._group = group
        self._process = subprocess.Popen(
            list(command),
            stdin=stdin,
            stdout=stdout,
            stderr=stderr,
            env=env,
            pass_fds=pass_fds,
            start_new_session=group,
        )

    @property
    def pid(self) -> int:
        """Process id; also the id of its group where it was started with `group`."""
        return self._process.pid

    @property
    def code(self) -> int | None:
        """Exit code; None: it runs."""
        return self._process.poll()

    @property
    def stdout(self) -> IO[bytes] | None:
        """Standard output, where that is a pipe."""
        return self._process.stdout

    def terminate(self) -> None:
        """Send SIGTERM."""
        if self.code is None:
            self._process.terminate()

    def kill(self) -> None:
        """Send SIGKILL to it, and to its group; does not wait."""
        if self._process.returncode is None:  # once reaped, the id may belong to another process
            with suppress(ProcessLookupError):
                if self._group:
                    os.killpg(self.pid, signal.SIGKILL)
                else:
                    self._process.kill()

    def wait(self, seconds: float) -> int:
        """Wait until it has ended, kill it after `seconds`, and return its exit code."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            return self._process.wait()

    def close(self) -> None:
        """Close this side of its pipes."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()


class Child:
    """A Python module that is kept running, with its log; it ends when this process does.

    Parameters
    ----------
    name : str
        Name in error messages.
    command : sequence of str
        A module and its arguments.
    log : Path
        File to which its standard error is appended.
    ready : str
        Beginning of the line that it prints when it is ready; empty: it prints none.
    lock : int
        Descriptor that it inherits.

    Attributes
    ----------
    address : str or None
        Rest of the line that it prints when it is ready; None: it has not printed that line yet.
    restarts : int
    """

    def __init__(self, name: str, command: Sequence[str], log: Path, ready: str, lock: int) -> None:
        self.name, self.command, self.log = name, tuple(command), log
        self.address: str | None = None
        self.restarts = 0
        self._ready, self._lock = ready, lock
        self._process: ChildProcess | None = None
        self._received = b""
        self._ends: deque[float] = deque(maxlen=MOST_ENDS)

    @property
    def pid(self) -> int | None:
        """Process id, also that of its group; None: there is no process."""
        return None if self._process is None else self._process.pid

    @property
    def code(self) -> int | None:
        """Exit code; None: it runs, or was not started."""
        return None if self._process is None else self._process.code

    def start(self) -> None:
        """Start it; its standard input is a pipe that closes with this process."""
        with self.log.open("ab") as log:
            self._process = ChildProcess(
                [sys.executable, "-m", "servotwin.runtime.child_process", *self.command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                group=True,
                pass_fds=(self._lock,),
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # several children share the cores
            )
        assert self._process.stdout is not None
        # Without blocking: the caller watches several children in one loop.
        os.set_blocking(self._process.stdout.fileno(), False)
        self._received = b""

    def read_output(self) -> None:
        """Read the lines that it has printed since, and take the address from the one that says it is ready."""
        if self._process is None or self._process.stdout is None:
            return
        while data := self._process.stdout.read(65536):
            # Bounded: a child that prints without line ends must not fill the memory.
            self._received = (self._received + data)[-65536:]
        *lines, self._received = self._received.split(b"\n")
        for line in lines:
            text = line.decode("utf-8", "replace")
            if self._ready and text.startswith(self._ready):
                self.address = text.removeprefix(self._ready).strip()

    def restart(self, now: float) -> None:
        """Start it once more after it ended by itself.

        Raises
        ------
        InvalidInput
            It ended `MOST_ENDS` times within `WITHIN_S`.
        """
        self._ends.append(now)
        if len(self._ends) == MOST_ENDS and now - self._ends[0] < WITHIN_S:
            raise self.failure(f"ended {MOST_ENDS} times within {now - self._ends[0]:.0f} s")
        self.release()
        self.restarts += 1
        self.start()

    def failure(self, what: str) -> InvalidInput:
        """Make the error that reports a failure of it, with the last line of its log."""
        line = last_line(self.log)
        return InvalidInput(f"{self.name} {what}{f': {line}' if line else ''} (see {self.log})")

    def terminate(self) -> None:
        """Ask it to end."""
        if self._process is not None:
            self._process.terminate()

    def kill(self) -> None:
        """Kill it and its group, and wait for its end."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(GRACE_S)

    def release(self) -> None:
        """Close the pipes of the process, which has ended."""
        if self._process is not None:
            self._process.close()
            self._process = None


def last_line(log: Path) -> str:
    """Return the last line of a file, cut to 300 characters; empty where there is no line or no file."""
    with suppress(OSError), log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - 4096))
        lines = [line.strip() for line in file.read().decode("utf-8", "replace").splitlines() if line.strip()]
        return lines[-1][-300:] if lines else ""
    return ""


def main(arguments: list[str]) -> None:
    """Run a module as `python -m` would, until it ends or standard input does."""
    Thread(target=_end_with_stdin, name="end with parent", daemon=True).start()
    sys.argv = arguments
    runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)


def _end_with_stdin() -> None:
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    # The module did not end by itself; its own children go with it.
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main(sys.argv[1:])
