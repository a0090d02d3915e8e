"""What was measured of speed and processor: the last seconds, and since the start."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

from servotwin.up.pacing import CORES, Seen, share_of
from servotwin.up.usage import Usage

_LATEST = 0.5
"""Weight of the newest measurement of the processor's share, which comes in bursts."""


class Mark(NamedTuple):
    """A machine's time (s) at a time by the wall (s)."""

    machine: float
    wall: float


class Paced:
    """Speed and share of processes and machines.

    Attributes
    ----------
    cores, share : float or None
        Cores' worth in use, and its share of two; None: not known.
    reached : float
        Machine time per time that the slowest machine kept.
    """

    def __init__(self) -> None:
        self.cores: float | None = None
        self.reached = 0.0
        self._usage = Usage()
        self._first: dict[str, Mark] = {}
        self._last: dict[str, Mark] = {}
        self._looks, self._total = 0, 0.0

    @property
    def share(self) -> float | None:
        """Of two cores."""
        return share_of(self.cores, os.cpu_count())

    @property
    def settled(self) -> bool:
        """Whether starting is over."""
        return self._looks > 1 and bool(self._last)

    @property
    def mean_speed(self) -> float:
        """Machine time per time since the first look, of the slowest machine."""
        return min((_speed(self._first[name], mark) for name, mark in self._last.items()), default=0.0)

    @property
    def mean_share(self) -> float | None:
        """Of two cores, since the second look."""
        return share_of(self._total / (self._looks - 1), os.cpu_count()) if self._looks > 1 else None

    @property
    def told_share(self) -> str:
        """In words."""
        share = self.mean_share
        return "an unknown share of the processor" if share is None else f"{100 * share:.0f} % of {CORES} cores"

    def seen(self, waiting: int) -> Seen:
        """For `pacing.next_speed`."""
        return Seen(self.share, self.reached, waiting)

    def look(self, used: dict[int, float] | None, marks: Mapping[str, Mark], now: float) -> None:
        """Measure once more.

        Parameters
        ----------
        used : dict of int to float, optional
            As `usage.times` gives it.
        marks : mapping of str to Mark
            By machine, as far as it says.
        now : float
            By the clock, s.
        """
        cores = self._usage.look(used, now)
        if cores is not None:
            self._looks, self._total = self._looks + 1, self._total + (cores if self._looks else 0.0)
            self.cores = cores if self.cores is None else self.cores + _LATEST * (cores - self.cores)
        moved = {name: mark for name, mark in marks.items() if name in self._last and mark.wall > self._last[name].wall}
        self.reached = min((_speed(self._last[name], mark) for name, mark in moved.items()), default=self.reached)
        self._last |= marks
        self._first = {**marks, **self._first}


def _speed(before: Mark, after: Mark) -> float:
    return (after.machine - before.machine) / (after.wall - before.wall) if after.wall > before.wall else 0.0
