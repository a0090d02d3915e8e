"""How much of the slow motion a fit leaves: noise is fast or small, a wrong channel is neither."""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.core.normal import least_squares
from servotwin.estimation.whitened.passes import Found
from servotwin.estimation.whitened.reduction import CONSTANT, RESIDUAL
from servotwin.plant.signals import Array

_SLOW_S = 0.06  # s: motions faster than this are averaged away, twice
_CHANCE = 6.0  # times what white noise would leave when averaged; decimated, it leaves twice that


def noise_left(found: Found) -> Array:
    """(m,) m, what the fit and its nuisances leave of the reduced position."""
    table = found.reduction.table(found.point)
    rows = found.reduction.prepared(found.noise, table, CONSTANT)
    return np.asarray(table[RESIDUAL] - least_squares(rows[CONSTANT:], rows[RESIDUAL]).coefficients @ table[CONSTANT:])


def slow_share(found: Found) -> float:
    """Slow part of what is left over the slow variation of the position, rms both; 0 where it can be noise.

    Where hardly anything moves, noise is most of the position's own variation, and that is no fault.
    """
    interval = found.reduction.response.interval * found.reduction.decimation.factor
    variation = float(np.std(slow(found.reduction.position, interval)))
    left = noise_left(found)
    remains = _rms(slow(left, interval))
    if remains <= _CHANCE * averaged_noise(left, interval) and _rms(left) <= loudest(found):
        return 0.0
    return remains / variation if variation > 0.0 else math.inf


def averaged_noise(values: Array, interval: float) -> float:
    """rms of the slow part of white noise that is from sample to sample as large as in a signal (m,)."""
    weights = np.convolve(averaging(interval), averaging(interval))
    return _rms(np.diff(values)) * math.sqrt(0.5 * float(weights @ weights))


def loudest(found: Found) -> float:
    """m: a sensor whose noise hides what the motor does, or does in a turn, measures something else."""
    reduction = found.reduction
    return abs(reduction.response.static_gain) * max(float(np.ptp(reduction.theta_m)), 2.0 * math.pi)


def averaging(interval: float) -> Array:
    """Weights (w,) of one average."""
    size = max(1, round(_SLOW_S / interval))
    return np.full(size, 1.0 / size)


def slow(values: Array, interval: float) -> Array:
    """A signal (m,) averaged twice."""
    window = averaging(interval)
    return np.convolve(np.convolve(values, window, "valid"), window, "valid")


def _rms(values: Array) -> float:
    return math.sqrt(float(values @ values) / values.size)
