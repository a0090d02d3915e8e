"""Block bootstrap of the gap: cycles of motion are drawn again whole, whatever the errors within one are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.estimation.kinematic.regression import least_gap, solved
from servotwin.plant.signals import Array

DRAWS = 300
_SEED = 2027


def units(strokes: int) -> Array:
    """(u, m) memberships: pairs of consecutive strokes, there and back; single strokes where there are few."""
    size = 2 if strokes >= 8 else 1
    return np.array([np.arange(strokes) // size == unit for unit in range(-(-strokes // size))], dtype=float)


class Spread(NamedTuple):
    """Bootstrap draws of the gap under two weightings of the samples.

    Attributes
    ----------
    gaps : (r,) array
        Every moment counts alike.
    by_travel : (r,) array
        Every bit of the motor's way counts alike.
    units : int
        Cycles that were drawn from.
    """

    gaps: Array
    by_travel: Array
    units: int

    @property
    def std(self) -> float:
        return float(self.gaps.std(ddof=1) * np.sqrt(self.units / max(self.units - 1, 1)))

    @property
    def std_of_difference(self) -> float:
        difference = self.gaps - self.by_travel
        return float(difference.std(ddof=1) * np.sqrt(self.units / max(self.units - 1, 1)))


def bootstrap(grid: Array, tensor: Array, by_travel: Array, used: list[int]) -> Spread:
    """Draw cycles with replacement; `tensor` and `by_travel` are (g, m, p, p) sums of products by stroke."""
    member = units(tensor.shape[1])
    drawn = np.random.default_rng(_SEED).multinomial(len(member), np.full(len(member), 1.0 / len(member)), DRAWS)
    counts = drawn @ member
    every = [
        solved(np.einsum("rm,gmij->rgij", counts, each, optimize=True), used).squares for each in (tensor, by_travel)
    ]
    return Spread(least_gap(grid, every[0]), least_gap(grid, every[1]), len(member))
