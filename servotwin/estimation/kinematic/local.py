"""The gap at every reversal: how it differs along the travel and over time."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from servotwin.plant.signals import Array

_LEAST, _CLEAR = 8, 0.9  # reversals, and correlation of their lost motion with the time
_SHARE = 0.25  # of a stroke, next to the reversal


class LocalGap(NamedTuple):
    """The gap that one reversal shows.

    Attributes
    ----------
    time : float
        s, of the reversal.
    position : float
        Of the load there, its unit.
    gap : float
        Total gap, the motor's unit.
    """

    time: float
    position: float
    gap: float


def local_gaps(
    time: Array, load: Array, side: Array, residual: Array, gap: float, ratio: float
) -> tuple[LocalGap, ...]:
    """Gap of each change of the flank, from what the fit with one gap leaves on either side of it.

    Parameters
    ----------
    time, load : (k,) array
    side : (k,) array
        Flank that was touched last; rows in the gap belong to the stroke before.
    residual : (k,) array
        Load less the fit, the load's unit.
    gap, ratio : float
        The fit's.
    """
    changes = np.flatnonzero(np.diff(side)) + 1
    edges = np.concatenate([[0], changes, [side.size]])
    strokes = list(pairwise(edges))
    result = []
    for place, change in enumerate(changes):
        before, after = (residual[part].mean() for part in _beside(strokes[place], strokes[place + 1]))
        # On the flank + the load is half a gap behind the motor: a larger gap puts it lower there, and higher on -.
        larger = -side[change] * (after - before) / ratio
        if np.isfinite(larger) and side[change] != 0 and side[change - 1] != 0:
            result.append(LocalGap(float(time[change]), float(load[change]), float(max(gap + larger, 0.0))))
    return tuple(result)


def _beside(before: tuple[int, int], after: tuple[int, int]) -> tuple[slice, slice]:
    """The rows of the strokes before and after a reversal that are near it."""
    length, other = before[1] - before[0], after[1] - after[0]
    return slice(before[1] - max(1, int(_SHARE * length)), before[1]), slice(
        after[0], after[0] + max(1, int(_SHARE * other))
    )


def drift_of(found: Sequence[LocalGap], unit: str) -> str:
    """Say that the lost motion of the reversals grows or falls while the log lasts; empty: it does not."""
    if len(found) < _LEAST:
        return ""
    times, gaps = (np.array([getattr(each, name) for each in found]) for name in ("time", "gap"))
    if np.ptp(times) == 0.0 or np.ptp(gaps) == 0.0 or abs(np.corrcoef(times, gaps)[0, 1]) < _CLEAR:
        return ""
    slope, value = np.polyfit(times - times[0], gaps, 1)
    return (
        f"the lost motion of the reversals goes from {value:.4g} to {value + slope * np.ptp(times):.4g} {unit} in this "
        "log: the machine changes; give the log in parts"
    )
