"""The twin as a process of its own, and the processor time and memory of each process, as the system counts them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from servotwin.errors import InvalidInput

_BEGIN_S, _END_S = 180.0, 60.0
_ADDRESS = re.compile(r"listening on http://127\.0\.0\.1:(\d+)")
_TICK = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100


class ProcessUsage(NamedTuple):
    """Processor time (s) and resident memory (bytes) of a process."""

    cpu: float
    memory: int


class MachineTimes(NamedTuple):
    """Processor time of the whole machine since it was started, all cores together, s.

    Attributes
    ----------
    busy : float
        Of all its processes, and of the kernel.
    withheld : float
        In which processes were ready to run, but the host of this virtual machine let others run.
    """

    busy: float
    withheld: float


class ServiceProcess(NamedTuple):
    """Running service of the twin.

    Attributes
    ----------
    process : Popen
    port : int
    """

    process: subprocess.Popen[str]
    port: int


def check_system() -> None:
    """Check that the system has /proc.

    Raises
    ------
    InvalidInput
    """
    if not Path("/proc/self/stat").exists():
        raise InvalidInput(
            "bench fleet reads processor times from /proc, which this system does not have: run it on Linux"
        )


@contextmanager
def service(folder: Path) -> Iterator[ServiceProcess]:
    """The twin of `twin.toml` in a folder, on a port of its own; its log goes to twin.log there.

    Raises
    ------
    RuntimeError
        The service does not start.
    """
    command = [sys.executable, "-m", "servotwin", "twin", "--config", str(folder / "twin.toml"), "--port", "0"]
    with (folder / "twin.log").open("wb") as log:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True, env=_environment()
        )
    try:
        yield ServiceProcess(process, _port(process, folder))
    finally:
        _end(process)


def used(pid: int) -> ProcessUsage | None:
    """Resource use of a process so far; None: it has ended."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        resident = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError):
        return None
    return ProcessUsage((int(stat[11]) + int(stat[12])) / _TICK, resident * os.sysconf("SC_PAGE_SIZE"))


def machine_times() -> MachineTimes:
    """Processor time of the whole machine so far."""
    user, nice, system, _idle, _waiting, interrupts, soft, stolen, *_ = map(
        int, Path("/proc/stat").read_text(encoding="ascii").partition("\n")[0].split()[1:]
    )
    return MachineTimes((user + nice + system + interrupts + soft) / _TICK, stolen / _TICK)


def children(pid: int) -> list[int]:
    """Running children of a process."""
    try:
        tasks = Path(f"/proc/{pid}/task").iterdir()
        return [int(each) for task in tasks for each in (task / "children").read_text(encoding="ascii").split()]
    except OSError:
        return []


def _port(process: subprocess.Popen[str], folder: Path) -> int:
    """Wait for the service's address; returns its port."""
    assert process.stdout is not None
    end = time.monotonic() + _BEGIN_S
    while time.monotonic() < end:
        match = _ADDRESS.search(process.stdout.readline())
        if match:
            return int(match[1])
        if process.poll() is not None:
            break
    log = (folder / "twin.log").read_text(encoding="utf-8", errors="replace")[-2000:]
    raise RuntimeError(f"the twin did not start: {log}")


def _end(process: subprocess.Popen[str]) -> None:
    """Terminate the service; kill its whole process group if it does not end."""
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _environment() -> dict[str, str]:
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
