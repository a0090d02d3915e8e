"""How wide a dead zone must be before the loop settles: the map behind the policy `margin`.

Backlash and dead zone are homogeneous of degree one, so with lengths in units of p gap (the screw's lost motion) a map
over (tolerance, step) holds for every gap. Settling is not monotone in the tolerance; what is told is therefore the
least tolerance from which on every wider one settled too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.plant.servo import Servo
from servotwin.simulation.ensemble import simulate_ensemble

# Settled means as still as 1 um in a gap of 1 mm.
_STILL = 1e-3
_DURATION, _LAST = 60.0, 20.0
_RATE = 50.0


@dataclass(frozen=True, eq=False)
class SettlingMap:
    """Which dead zones settle.

    Attributes
    ----------
    k_dz : (K,) array
        Tolerances in units of p gap, ascending.
    steps : (S,) array
        Steps of the reference in units of p gap, ascending.
    settled : (K, S) array of bool
        Whether every start of the screw settled.
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
def settling_map(servo: Servo, controller: Controller | None = None, starts: int = 4) -> SettlingMap:
    """The map of a servo with its own or another continuous controller, about a second of simulation.

    Raises
    ------
    InvalidInput
        The controller is sampled, saturates or has a loop filter.
    """
    k_dz, steps = np.arange(0.25, 3.01, 0.125), np.geomspace(0.05, 500.0, 33)
    gap = 1.0
    unit = servo.p * gap
    screw = np.linspace(-0.5, 0.5, starts) * gap
    k, r, w = np.meshgrid(k_dz, steps, screw, indexing="ij")
    position = simulate_ensemble(servo, _DURATION, unit * r, gap, unit * k, w, controller, _RATE)
    last = position[..., -round(_LAST * _RATE) :] / unit
    return SettlingMap(k_dz, steps, (0.5 * np.ptp(last, axis=-1) < _STILL).all(axis=-1))
