"""Samples that no machine has: spikes, short excursions, and values that stood still until they jumped."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from servotwin.plant.signals import Array

_FAR = 20.0  # times the usual step between samples
_USUAL = 0.99  # quantile of the steps that are no rests
_BACK = 0.2  # of a jump: what the way back may differ by
_LONGEST = 100  # samples of an excursion
_FEW = 0.02  # of the samples: jumps that come more often are how the channel moves


def outliers(values: Array) -> Any:
    """(n,) true for samples that jump away and back by far more than others move, and for such a first or last one."""
    result, jumps = np.zeros(values.size, dtype=np.bool_), _jumps(values)
    for first, last in pairwise(jumps):
        there, back = values[first + 1] - values[first], values[last + 1] - values[last]
        if last - first <= _LONGEST and not result[first] and abs(there + back) < _BACK * abs(there):
            result[first + 1 : last + 1] = True
    if jumps.size and jumps[0] == 0 and not result[1]:
        result[0] = True
    if jumps.size and jumps[-1] == values.size - 2 and not result[-2]:
        result[-1] = True
    return result


def frozen(values: Array) -> Any:
    """(n,) true for repeats of a value that end in a jump by far more than others move: the channel was not read."""
    result = np.zeros(values.size, dtype=np.bool_)
    for jump in _jumps(values):
        same = values[: jump + 1] != values[jump]
        begin = int(np.flatnonzero(same)[-1]) + 1 if same.any() else 0
        result[begin + 1 : jump + 1] = True
    return result


def _jumps(values: Array) -> Any:
    """Places of the samples before steps that are far larger than others."""
    steps = np.abs(np.diff(values))
    moving = steps[steps > 0.0]
    if values.size < 5 or not moving.size:
        return np.zeros(0, dtype=int)
    far = np.flatnonzero(steps > _FAR * float(np.quantile(moving, _USUAL)))
    return far if far.size <= _FEW * values.size else np.zeros(0, dtype=int)
