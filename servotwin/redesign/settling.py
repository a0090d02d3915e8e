"""Map of the dead zones for which the loop settles; the policy `margin` reads it.

Settling is not monotone in the tolerance; the map therefore gives the least tolerance from which on every wider one
settled too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from servotwin.analysis.maps.axes import RatioAxes
from servotwin.analysis.maps.measures import compute_cells
from servotwin.analysis.maps.settings import MapSettings
from servotwin.hybrid.automaton import Array
from servotwin.plant.plants import Plant
from servotwin.plant.scales import scales

# In units of p gap, the screw's lost motion; the map's own unit p b is half of it.
_K_DZ, _STEPS = np.arange(0.25, 3.01, 0.125), np.geomspace(0.05, 500.0, 33)
_UNITS = 2.0
# The scale of a map is free; settled means as still as 1 um where the lost motion is 1 mm.
_GAP, _STILL = 1.0, 1e-3
_STARTS, _DURATION, _LAST = 4, 60.0, 20.0  # s of the servo's own


@dataclass(frozen=True, eq=False)
class SettlingMap:
    """Dead zones for which the loop settles.

    Attributes
    ----------
    k_dz : (K,) array
        Tolerances in units of p gap, ascending.
    steps : (S,) array
        Steps of the reference in units of p gap, ascending.
    settled : (K, S) array of bool
        True where the loop settled from every start of the screw.
    """

    k_dz: Array
    steps: Array
    settled: NDArray[np.bool_]

    def least(self, low: float, high: float) -> float:
        """The least k_dz from which on all settled for steps between `low` and `high` (units of p gap); inf: none.

        Steps beyond the map count as its nearest ones.
        """
        ends = np.clip([low, high], self.steps[0], self.steps[-1])
        first = max(int(np.searchsorted(self.steps, ends[0], side="right")) - 1, 0)
        last = int(np.searchsorted(self.steps, ends[1], side="left"))
        fails = np.flatnonzero(~self.settled[:, first : last + 1].all(axis=1))
        start = 0 if fails.size == 0 else int(fails[-1]) + 1
        return float(self.k_dz[start]) if start < self.k_dz.size else math.inf


@lru_cache(maxsize=8)
def settling_map(servo: Plant) -> SettlingMap:
    """The map of a servo with its own continuous controller, from rest; some seconds of simulation.

    Raises
    ------
    InvalidInput
        The controller is sampled, or does not stabilise the servo even without a gap.
    """
    axes = RatioAxes(tuple((_UNITS * _K_DZ).tolist()), tuple((_UNITS * _STEPS).tolist()), _GAP)
    still, second = _STILL * servo.p * _GAP, scales(servo).time
    duration, window = _DURATION * second, _LAST * second
    settings = MapSettings(servo, axes, members=_STARTS, motion=0.0, duration=duration, window=window, still=still)
    measures = compute_cells(settings)
    return SettlingMap(_K_DZ, _STEPS, (measures.settled == 1.0).reshape(axes.shape))
