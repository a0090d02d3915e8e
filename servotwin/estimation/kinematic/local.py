"""The gap at every reversal: how it differs along the travel and over time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.plant.signals import Array

_LEAST_ROWS = 8


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
    means = np.array(
        [residual[a:b].mean() if b - a >= _LEAST_ROWS else np.nan for a, b in zip(edges, edges[1:], strict=False)]
    )
    result = []
    for place, change in enumerate(changes):
        before, after = means[place], means[place + 1]
        # On the flank + the load is half a gap behind the motor: with a larger gap it lies lower there, and higher on -.
        larger = -side[change] * (after - before) / ratio
        if np.isfinite(larger) and side[change] != 0 and side[change - 1] != 0:
            result.append(LocalGap(float(time[change]), float(load[change]), float(max(gap + larger, 0.0))))
    return tuple(result)
