"""Speed of machine time: measured against the processor's use (from /proc), and chosen as high as that allows."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

SLOWEST, FASTEST = 5.0, 100.0
"""Machine time per time."""
LIMIT, TARGET = 0.60, 0.52
"""Shares of two cores: the limit, and the set point below it."""
CORES = 2
_MAX_WAITING = 10
"""Messages that may wait for the twin; more mean that its queue grows."""
_DEADBAND, _REACHED = 0.08, 0.93
"""Relative change of speed that is not made; share of the set speed that a machine in time reaches."""
_SMOOTHING = 0.5
"""Weight of the newest measurement of the processor's share, which comes in bursts."""
_PROC = Path("/proc")
_GROUP, _USER, _SYSTEM = 2, 11, 12
"""Fields of /proc/PID/stat after the name."""


class SpeedSample(NamedTuple):
    """Measured effect of a speed.

    Attributes
    ----------
    share : float or None
        Share of two cores; None: unknown.
    reached : float
        Machine time per time of the slowest machine.
    waiting : int
        Messages that wait for the twin.
    """

    share: float | None
    reached: float
    waiting: int


def share_of(cores_used: float | None, cores: int | None) -> float | None:
    """Share of two cores, or of the only one."""
    return None if cores_used is None else cores_used / min(CORES, cores or 1)


def next_speed(speed: float, measured: SpeedSample) -> float:
    """Choose the next speed: at least `SLOWEST`, even where the machine cannot hold that."""
    if measured.share is None:
        factor = 1.0
    elif measured.share > LIMIT:
        factor = max(0.5, TARGET / measured.share)
    elif measured.reached < _REACHED * speed:
        factor = max(0.5, measured.reached / speed)
    elif measured.waiting > _MAX_WAITING:
        factor = 0.8
    else:
        factor = min(1.3, TARGET / max(measured.share, 0.01))
        factor = 1.0 if abs(factor - 1.0) < _DEADBAND else factor
    return round(min(max(speed * factor, SLOWEST), FASTEST), 1)


class MachineTime(NamedTuple):
    """Time of a machine (s) at a wall-clock time (s)."""

    machine: float
    wall: float


class SpeedMeter:
    """Measures the speed of machines and the processor time of processes.

    Attributes
    ----------
    cores : float or None
        Cores in use; None: unknown.
    reached : float
        Machine time per time of the slowest machine.
    """

    def __init__(self) -> None:
        self.cores: float | None = None
        self.reached = 0.0
        self._usage = CoreUsage()
        self._first: dict[str, MachineTime] = {}
        self._last: dict[str, MachineTime] = {}
        self._measurements, self._total = 0, 0.0

    @property
    def share(self) -> float | None:
        """Share of two cores."""
        return share_of(self.cores, os.cpu_count())

    @property
    def started(self) -> bool:
        """True once the start is over, so that measurements count."""
        return self._measurements > 1 and bool(self._last)

    @property
    def mean_speed(self) -> float:
        """Machine time per time since the first measurement, of the slowest machine."""
        return min((_speed(self._first[name], last) for name, last in self._last.items()), default=0.0)

    @property
    def mean_share(self) -> float | None:
        """Share of two cores since the second measurement."""
        if self._measurements < 2:
            return None
        return share_of(self._total / (self._measurements - 1), os.cpu_count())

    def sample(self, waiting: int) -> SpeedSample:
        """Last measurement, for `next_speed`."""
        return SpeedSample(self.share, self.reached, waiting)

    def measure(self, used: dict[int, float] | None, times: Mapping[str, MachineTime], now: float) -> None:
        """Add a measurement.

        Parameters
        ----------
        used : dict of int to float, optional
            As `processor_times` returns it.
        times : mapping of str to MachineTime
            By machine, as far as known.
        now : float
            Monotonic clock, s.
        """
        cores = self._usage.measure(used, now)
        if cores is not None:
            # The first measurement contains the start, when processes import and compile.
            self._total += cores if self._measurements else 0.0
            self._measurements += 1
            self.cores = cores if self.cores is None else self.cores + _SMOOTHING * (cores - self.cores)
        advanced = {name: new for name, new in times.items() if name in self._last and new.wall > self._last[name].wall}
        self.reached = min((_speed(self._last[name], new) for name, new in advanced.items()), default=self.reached)
        self._last |= times
        self._first = {**times, **self._first}


def _speed(before: MachineTime, after: MachineTime) -> float:
    return (after.machine - before.machine) / (after.wall - before.wall) if after.wall > before.wall else 0.0


class CoreUsage:
    """Cores in use between two measurements."""

    def __init__(self) -> None:
        self._before: dict[int, float] = {}
        self._last: float | None = None

    def measure(self, used: dict[int, float] | None, now: float) -> float | None:
        """Cores used since the last measurement; None: unknown.

        Parameters
        ----------
        used : dict of int to float, optional
            As `processor_times` returns it. A process that has ended counts up to the last measurement.
        now : float
            Monotonic clock, s.
        """
        before, last = self._before, self._last
        self._before, self._last = used or {}, now
        if used is None or last is None or not now > last:
            return None
        return sum(max(0.0, time - before.get(pid, 0.0)) for pid, time in used.items()) / (now - last)


def processor_times(groups: Collection[int], processes: Collection[int], root: Path = _PROC) -> dict[int, float] | None:
    """Processor time (s) by process id, of process groups and single processes; None: unknown on this system."""
    try:
        names = [entry.name for entry in root.iterdir() if entry.name.isdecimal()]
    except OSError:
        return None
    tick = os.sysconf("SC_CLK_TCK")
    stats = ((int(name), _stat(root / name / "stat")) for name in names)
    used = {
        pid: (int(stat[_USER]) + int(stat[_SYSTEM])) / tick
        for pid, stat in stats
        if len(stat) > _SYSTEM and (int(stat[_GROUP]) in groups or pid in processes)
    }
    return used or None


def _stat(path: Path) -> list[str]:
    """Fields after the program's name, which may hold anything; empty: the process has ended."""
    try:
        return path.read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []
