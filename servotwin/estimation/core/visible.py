"""Smallest angles that a window can show: those of the paper's servo, or fewer where the encoder is known to be fine.

A screw that turns by half a degree in a contact shows the contact on any machine. A ball screw with a gap of a third of
a degree turns by less in a calm loop, and an encoder of a million counts shows that as well.
"""

from __future__ import annotations

import math

import numpy as np

from servotwin.plant.signals import Array

TRAVEL, BOUND = math.radians(0.5), math.radians(0.1)
_SHARE = 1.0 / 3.0  # of the gap
_TRAVEL_COUNTS, _BOUND_COUNTS = 100.0, 30.0
# Of a count, for samples that were rounded twice; steps that are so many counts long tell nothing of it; so many do.
_ROUNDED_AGAIN, _NEAR, _ENOUGH = 0.1, 4.5, 12


def least_travel(gap: float, resolution: float) -> float:
    """Least travel (rad) of the screw in each contact, for a gap (rad) and one count of the encoder (rad; 0: unknown).

    No more than a third of the gap, but a hundred counts.
    """
    return min(TRAVEL, max(_SHARE * gap, _TRAVEL_COUNTS * resolution)) if resolution > 0.0 else TRAVEL


def least_bound(resolution: float) -> float:
    """Smallest lower bound (rad) that says anything, for one count of the encoder (rad; 0: unknown)."""
    return min(BOUND, _BOUND_COUNTS * resolution) if resolution > 0.0 else BOUND


def counted(angle: Array) -> float:
    """Count (rad) of an encoder that shows in its angle, all values of which lie on one grid; 0 where none shows.

    Samples that were rounded once more, for the link or a log, lie beside that grid, by less than a tenth of it.
    """
    values = np.unique(angle)
    # An angle that moves evenly takes evenly spaced values too, but each of them once.
    if not 3 <= values.size <= 0.75 * angle.size:
        return 0.0
    steps = np.diff(values)
    least = float(steps.min())
    if np.all(_beside_grid(steps, least) <= 1e-3 * steps):
        return least
    count = float(np.mean(steps[steps < 1.5 * least]))
    near = steps[steps < _NEAR * count]
    return count if near.size >= _ENOUGH and np.all(_beside_grid(near, count) <= _ROUNDED_AGAIN * count) else 0.0


def _beside_grid(steps: Array, count: float) -> Array:
    """Distances (as the steps) of steps from the next multiples of a count."""
    return np.abs(steps - count * np.round(steps / count))
