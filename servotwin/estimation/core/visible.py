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


def least_travel(gap: float, resolution: float) -> float:
    """Least travel (rad) of the screw in each contact, for a gap (rad) and one count of the encoder (rad; 0: unknown).

    No more than a third of the gap, but a hundred counts.
    """
    return min(TRAVEL, max(_SHARE * gap, _TRAVEL_COUNTS * resolution)) if resolution > 0.0 else TRAVEL


def least_bound(resolution: float) -> float:
    """Smallest lower bound (rad) that says anything, for one count of the encoder (rad; 0: unknown)."""
    return min(BOUND, _BOUND_COUNTS * resolution) if resolution > 0.0 else BOUND


def counted(angle: Array) -> float:
    """Count (rad) of an encoder that shows in its angle, all values of which lie on one grid; 0 where none shows."""
    values = np.unique(angle)
    # An angle that moves evenly takes evenly spaced values too, but each of them once.
    if not 3 <= values.size <= 0.75 * angle.size:
        return 0.0
    steps = np.diff(values)
    ratios = steps / steps.min()
    even = np.abs(ratios - np.round(ratios)) <= 1e-3 * ratios
    return float(steps.min()) if np.all(even) else 0.0
