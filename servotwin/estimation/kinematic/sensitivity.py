"""Sensitivity of the gap to errors that no model has: large where the load moves little beyond it, or at one speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servotwin.plant.signals import Array

_LEAST = 1e-6  # share of the flanks' variance that other columns leave


class Sensitivity(NamedTuple):
    """Deviation of the gap by an error of the load's position, over the one that long strokes at many speeds have.

    Attributes
    ----------
    motor : float
        On the motor's side: what the flank does to the load is partly what ratio, lag and cyclic errors do too.
    load : float
        On the load's side, whose ratio is estimated with the gap.
    """

    motor: float
    load: float


def sensitivity(values: Array, used: Sequence[int], side: Array, gap: float) -> Sensitivity:
    """Compare the flanks with the columns (p, k) of a model, of which the first in `used` is the play's output.

    Parameters
    ----------
    side : (k,) array
        Flank that was touched last.
    gap : float
        The motor's unit.
    """
    others = values[list(used)]
    by_motor = others.copy()
    by_motor[0] += 0.5 * gap * side
    return Sensitivity(_inflation(side, others), _inflation(side, by_motor))


def _inflation(side: Array, others: Array) -> float:
    """One over the share of the flanks, as a root mean square, that other columns do not explain."""
    flank = side.astype(float)
    scale = np.sqrt(np.sum(others**2, axis=1))
    unit = others / np.where(scale > 0.0, scale, 1.0)[:, None]
    found = np.linalg.lstsq(unit @ unit.T, unit @ flank, rcond=1e-12)[0]
    left = float(np.mean((flank - found @ unit) ** 2))
    return float(np.mean(flank**2) / max(left, _LEAST)) ** 0.5
