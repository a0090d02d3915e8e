"""How much of the slow motion a fit leaves: noise is fast or small, a wrong channel is neither."""

from __future__ import annotations

import math

import numpy as np

from servotwin.identify.core.normal import least_squares
from servotwin.identify.whitened.passes import Found
from servotwin.identify.whitened.reduction import CONSTANT, RESIDUAL
from servotwin.plant.signals import Array

_SLOW_S = 0.06  # s: motions faster than this are averaged away, twice


def noise_left(found: Found) -> Array:
    """(m,) m, what the fit and its nuisances leave of the reduced position."""
    table = found.reduction.table(found.point)
    rows = found.reduction.prepared(found.noise, table, CONSTANT)
    return np.asarray(table[RESIDUAL] - least_squares(rows[CONSTANT:], rows[RESIDUAL]).coefficients @ table[CONSTANT:])


def slow_share(found: Found) -> float:
    """Slow part of what is left over the slow variation of the position, rms both."""
    interval = found.reduction.response.interval * found.reduction.decimation.factor
    moved = slow(found.reduction.position, interval)
    variation = float(np.std(moved))
    left = slow(noise_left(found), interval)
    return math.sqrt(float(left @ left) / left.size) / variation if variation > 0.0 else math.inf


def slow(values: Array, interval: float) -> Array:
    """A signal (m,) averaged twice."""
    window = np.full(max(1, round(_SLOW_S / interval)), 1.0)
    window /= window.size
    return np.convolve(np.convolve(values, window, "valid"), window, "valid")
