"""Time stamps of a log: the order of its samples, and stamps that are coarser than the samples."""

from __future__ import annotations

from bisect import bisect_right
from typing import Any

import numpy as np

from servotwin.plant.signals import Array

_SHARED = 0.3  # of the samples: stamps that so many share are coarser than the samples
_SAME = 0.9  # of those: copies of the sample before, whatever their stamp
_LONGEST = 3.0  # times the usual interval: samples before a pause are not spread over it


def in_order(time: Array) -> Any:
    """(n,) true for the samples of the longest sequence whose times do not fall: single wrong stamps leave it."""
    if not np.any(np.diff(time) < 0.0):
        return np.ones(time.size, dtype=np.bool_)
    ends: list[float] = []  # least last time of a sequence of each length
    places: list[int] = []  # of these
    before = np.full(time.size, -1)
    for row, stamp in enumerate(time.tolist()):
        length = bisect_right(ends, stamp)
        if length == len(ends):
            ends.append(stamp)
            places.append(row)
        else:
            ends[length], places[length] = stamp, row
        before[row] = places[length - 1] if length else -1
    kept = np.zeros(time.size, dtype=np.bool_)
    row = places[-1]
    while row >= 0:
        kept[row] = True
        row = int(before[row])
    return kept


def copies(table: Array) -> Any:
    """(n,) true for rows that repeat the row before, time stamp included."""
    return np.concatenate([[False], np.all(np.diff(table, axis=0) == 0.0, axis=1)]) if len(table) else np.zeros(0, bool)


def spread(table: Array) -> tuple[Array, int]:
    """Spread samples evenly that share a time stamp, if many do, and count them; `table` (n, c) has times first.

    Copies of the sample before are none: where most are copies, nothing is spread.
    """
    time = table[:, 0]
    begins = np.flatnonzero(np.concatenate([[True], np.diff(time) > 0.0])) if time.size else np.zeros(0, dtype=int)
    shared = time.size - begins.size
    if begins.size < 2 or shared < _SHARED * time.size or np.sum(copies(table)) > _SAME * shared:
        return time, 0
    sizes = np.diff(begins, append=time.size)
    steps = np.diff(time[begins]) / sizes[:-1]
    usual = float(np.median(steps))
    steps = np.minimum(np.append(steps, usual), _LONGEST * usual)
    within = np.arange(time.size) - np.repeat(begins, sizes)
    return time + within * np.repeat(steps, sizes), int(shared)
