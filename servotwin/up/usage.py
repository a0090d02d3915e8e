"""How much of the processor process groups use, from /proc; where there is none, nobody knows."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

PROC = Path("/proc")
_GROUP, _USER, _SYSTEM = 2, 11, 12
"""Places in /proc/PID/stat behind the name."""


def times(groups: Collection[int], processes: Collection[int], root: Path = PROC) -> dict[int, float] | None:
    """Processor time (s) of each process in these groups, and of these processes, by id; None: not known here."""
    try:
        names = [entry.name for entry in root.iterdir() if entry.name.isdecimal()]
    except OSError:
        return None
    tick = os.sysconf("SC_CLK_TCK")
    found = ((int(name), _stat(root / name / "stat")) for name in names)
    used = {
        pid: (int(stat[_USER]) + int(stat[_SYSTEM])) / tick
        for pid, stat in found
        if _in(stat, groups) or (stat and pid in processes)
    }
    return used or None


def _stat(path: Path) -> list[str]:
    """What stands behind the name of the program, which may hold anything; empty: the process is gone."""
    try:
        return path.read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def _in(stat: list[str], groups: Collection[int]) -> bool:
    return len(stat) > _SYSTEM and int(stat[_GROUP]) in groups


class Usage:
    """Cores in use, from one look to the next."""

    def __init__(self) -> None:
        self._before: dict[int, float] = {}
        self._then: float | None = None

    def look(self, used: dict[int, float] | None, now: float) -> float | None:
        """Cores' worth used since the last look; None: not known.

        Parameters
        ----------
        used : dict of int to float, optional
            As `times` gives it. A process that is gone counts up to the last look.
        now : float
            By the clock, s.
        """
        before, then = self._before, self._then
        self._before, self._then = used or {}, now
        if used is None or then is None or not now > then:
            return None
        return sum(max(0.0, time - before.get(pid, 0.0)) for pid, time in used.items()) / (now - then)
