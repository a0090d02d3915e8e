"""Resource use during a run, read from /proc and the store: processor time, memory, backlog."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from benchmarks.fleet.processes import MachineTimes, ProcessUsage, children, machine_times, used

EDGES, TWIN, WORKERS = "edges", "twin", "workers"


class ResourceSample(NamedTuple):
    """One sample.

    Attributes
    ----------
    time : float
        s since the beginning.
    used : dict of str to ProcessUsage
        By role: the edges, the twin's own process, its workers together.
    waiting : int
        Windows that are committed and not worked on.
    age : float
        s, of the oldest of them.
    machine : MachineTimes
    """

    time: float
    used: dict[str, ProcessUsage]
    waiting: int
    age: float
    machine: MachineTimes


@dataclass
class ResourceWatch:
    """Sample the resource use of processes.

    Parameters
    ----------
    twin, edges : int
        Process ids.
    waiting : callable
        () -> (windows that wait, age of the oldest in s).
    """

    twin: int
    edges: int
    waiting: Callable[[], tuple[int, float]]
    samples: list[ResourceSample] = field(default_factory=list)
    _begin: float = field(default_factory=time.monotonic)

    def look(self) -> ResourceSample:
        """Take one sample."""
        workers = [usage for pid in children(self.twin) if (usage := used(pid))]
        roles = {EDGES: used(self.edges), TWIN: used(self.twin)}
        now = {role: usage for role, usage in roles.items() if usage is not None}
        now[WORKERS] = ProcessUsage(sum(each.cpu for each in workers), sum(each.memory for each in workers))
        sample = ResourceSample(time.monotonic() - self._begin, now, *self.waiting(), machine_times())
        self.samples.append(sample)
        return sample

    def spent(self, role: str) -> float:
        """Processor time of a role between the first and the last sample, s."""
        times = [sample.used[role].cpu for sample in self.samples if role in sample.used] or [0.0]
        return times[-1] - times[0]

    def cores(self, role: str) -> float:
        """Cores that a role kept busy meanwhile, on average."""
        times = [sample.time for sample in self.samples if role in sample.used]
        return self.spent(role) / (times[-1] - times[0]) if len(times) > 1 else 0.0

    def elsewhere(self) -> tuple[float, float]:
        """Cores that processes of no role kept busy, and cores that the host withheld, on average."""
        if len(self.samples) < 2:
            return 0.0, 0.0
        first, last = self.samples[0], self.samples[-1]
        seconds = last.time - first.time
        others = last.machine.busy - first.machine.busy - sum(self.spent(role) for role in (EDGES, TWIN, WORKERS))
        return max(0.0, others) / seconds, (last.machine.withheld - first.machine.withheld) / seconds

    def memory(self, role: str) -> tuple[int, int, int]:
        """Memory in the first sample, half-way and at most, bytes."""
        sizes = [sample.used[role].memory for sample in self.samples if role in sample.used] or [0]
        return sizes[0], sizes[len(sizes) // 2], max(sizes)
