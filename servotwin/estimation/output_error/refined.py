"""A sampled motion at more places: between two samples a polynomial through the smoothest of the samples around them.

A motor whose command jumps at a tick starts with a corner. A cubic with the slopes of both its sides cuts it, and where
the motor crosses the gap there, the load shows it. Of the runs of four samples about an interval the one whose
third difference is the smallest lies on one side of the corner: essentially non-oscillatory interpolation, of which
Harten, Engquist, Osher and Chakravarthy (J. Comput. Phys. 71, 1987) let the run grow sample by sample.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.signals import Array

CUBIC, PARABOLA = 4, 3  # samples that a polynomial goes through


def refined(values: Array, parts: int, through: int = CUBIC) -> Array:
    """((n - 1) parts + 1,) values at so many parts of each interval of samples (n,), n at least 4."""
    first, table = _smoothest(values, through), _weights(parts, through)
    places = np.arange(values.size - 1)
    between = np.einsum("ijk,ik->ij", table[places - first], values[first[:, None] + np.arange(through)])
    return np.append(between.ravel(), values[-1])


def _smoothest(values: Array, through: int) -> NDArray[np.intp]:
    """(n - 1,) first samples of the runs about each interval whose highest differences are the smallest."""
    reach = through - 2
    sizes = np.pad(np.abs(np.diff(values, through - 1)), reach, constant_values=math.inf)
    # Of the runs that contain an interval, the one in the middle where they are alike.
    order = sorted(range(through - 1), key=lambda place: abs(place - 0.5 * reach))
    runs = np.array([sizes[reach - place : reach - place + values.size - 1] for place in order])
    return np.arange(values.size - 1) - np.array(order)[np.argmin(runs, axis=0)]


def _weights(parts: int, through: int) -> Array:
    """(runs, parts, through) weights of a run's samples at the parts of an interval, by the interval's place in it."""
    run, table = np.arange(through), np.ones((through - 1, parts, through))
    for place in range(through - 1):
        at = place + np.arange(parts) / parts
        for i in run:
            for other in run[run != i]:
                table[place, :, i] *= (at - other) / (i - other)
    return table
