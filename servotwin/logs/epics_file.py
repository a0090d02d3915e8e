"""EPICS text: the lines of camonitor, pvmonitor or an archiver's export, one event of one process variable each."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import LogColumns, Requested, among
from servotwin.logs.dates import time_of
from servotwin.plant.signals import Array

TIME = "time_s"
_LINE = re.compile(r"^\s*(\S+)\s+(\d{4}-\d\d-\d\d|\d\d/\d\d/\d{4})[T ]+(\d\d:\d\d:\d\d(?:\.\d+)?)\s+(\S+)(.*)$")


def looks_like_epics(line: str) -> bool:
    """True for a line with a name, a date, a time and a value."""
    return _LINE.match(line) is not None


def read_epics(path: Path, requested: Requested) -> LogColumns:
    """Read one column for each process variable and `time_s`; between its events a variable is interpolated or held.

    A position that was quiet for long is held until shortly before its next event; one that moves is interpolated.
    """
    events: dict[str, tuple[list[float], list[float]]] = {}
    damaged: dict[str, str] = {}
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            found = _LINE.match(line)
            if not found:
                continue
            name, day, clock, value, _ = found.groups()
            times, values = events.setdefault(name, ([], []))
            try:
                measured = float(value)
            except ValueError:
                damaged.setdefault(name, f"line {number}: {value[:30]!r}")
                continue
            stamp = time_of(f"{day} {clock}")
            if stamp is not None:
                times.append(stamp)
                values.append(measured)
    if not events:
        raise InvalidInput(f"log {path}: no line reads NAME YYYY-MM-DD HH:MM:SS VALUE, as camonitor writes")
    names = [TIME, *events]
    requested = among(requested, names)
    wanted = [name for name in events if name in requested] or list(events)
    time = np.unique(np.concatenate([np.sort(events[name][0]) for name in wanted]))
    columns: dict[str, Array] = {name: _between(time, *map(np.array, events[name])) for name in wanted}
    columns[TIME] = time
    chosen = {name: column for name, column in columns.items() if name in requested}
    return LogColumns(chosen, names, {}, {name: text for name, text in damaged.items() if name in chosen})


def _between(time: Array, at: Array, values: Array) -> Array:
    """Values at other times: interpolated between near events, held before a far one, NaN before the first."""
    if not at.size:
        return np.full(time.size, np.nan)
    order = np.argsort(at, kind="stable")
    at, values = at[order], values[order]
    steps = np.diff(at)
    usual = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
    far = np.flatnonzero(steps > 5.0 * usual)
    at = np.insert(at, far + 1, at[far + 1] - usual) if far.size else at
    values = np.insert(values, far + 1, values[far]) if far.size else values
    result = np.interp(time, at, values)
    result[time < at[0]] = np.nan
    return result
