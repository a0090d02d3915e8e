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
    at_load : (r,) array
        `gaps` times the ratio that goes with each.
    units : int
        Cycles that were drawn from.
    """

    gaps: Array
    by_travel: Array
    at_load: Array
    units: int

    @property
    def std(self) -> float:
        return self._std(self.gaps)

    @property
    def std_of_difference(self) -> float:
        return self._std(self.gaps - self.by_travel)

    @property
    def std_at_load(self) -> float:
        return self._std(self.at_load)

    def _std(self, values: Array) -> float:
        return float(values.std(ddof=1) * np.sqrt(self.units / max(self.units - 1, 1)))


def bootstrap(grid: Array, tensor: Array, by_travel: Array, used: list[int]) -> Spread:
    """Draw cycles with replacement; `tensor` and `by_travel` are (g, m, p, p) sums of products by stroke."""
    member = units(tensor.shape[1])
    drawn = np.random.default_rng(_SEED).multinomial(len(member), np.full(len(member), 1.0 / len(member)), DRAWS)
    counts = drawn @ member
    by_time, other = (
        solved(np.einsum("rm,gmij->rgij", counts, each, optimize=True), used) for each in (tensor, by_travel)
    )
    gaps = least_gap(grid, by_time.squares)
    ratios = [np.interp(gap, grid, each) for gap, each in zip(gaps, by_time.coefficients[..., 0], strict=True)]
    return Spread(gaps, least_gap(grid, other.squares), gaps * np.abs(ratios), len(member))
