"""Resource use during a run, seen from outside: processor time, memory, and the backlog."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from benchmarks.fleet.processes import ProcessUsage, children, used

EDGES, TWIN, WORKERS = "edges", "twin", "workers"


class ResourceSample(NamedTuple):
    """One look.

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
    """

    time: float
    used: dict[str, ProcessUsage]
    waiting: int
    age: float


@dataclass
class ResourceWatch:
    """Looks at processes.

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
        """Once."""
        workers = [found for pid in children(self.twin) if (found := used(pid))]
        roles = {EDGES: used(self.edges), TWIN: used(self.twin)}
        now = {role: found for role, found in roles.items() if found is not None}
        now[WORKERS] = ProcessUsage(sum(each.cpu for each in workers), sum(each.memory for each in workers))
        sample = ResourceSample(time.monotonic() - self._begin, now, *self.waiting())
        self.samples.append(sample)
        return sample

    def spent(self, role: str) -> float:
        """s of processor time between the first and the last look at a role."""
        seen = [sample.used[role].cpu for sample in self.samples if role in sample.used] or [0.0]
        return seen[-1] - seen[0]

    def cores(self, role: str) -> float:
        """Cores that a role kept busy meanwhile."""
        times = [sample.time for sample in self.samples if role in sample.used]
        return self.spent(role) / (times[-1] - times[0]) if len(times) > 1 else 0.0

    def memory(self, role: str) -> tuple[int, int, int]:
        """Bytes at the first look, half-way and at most."""
        seen = [sample.used[role].memory for sample in self.samples if role in sample.used] or [0]
        return seen[0], seen[len(seen) // 2], max(seen)
