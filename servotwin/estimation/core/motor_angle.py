"""A motor's angle without its measurement noise, where a rigid screw follows it through its gap.

Play follows the extremes of a noisy angle, so that the gap seems wider, and an angle that is delayed by half a sample
is quieter than one that is not: both speak for wrong gaps. A local parabola is fitted about every sample, over as many
samples to both sides, before or after it as agree on one value within the noise (intersection of confidence
intervals, Goldenshluger and Nemirovski 1997), so that reversals stay as sharp as they are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.counts import between_counts
from servotwin.plant.signals import Array

_ONE_STD = 0.683  # share of a normal distribution within one standard deviation
_REACHES = (4, 8, 16, 32, 64)  # samples to a side
_INTERVAL = 2.5  # standard deviations, half-width of the intervals that intersect
_EVENLY = 1.0 / math.sqrt(12.0)  # of a count: standard deviation of its rounding
_DITHERED = 0.5  # of a count: from this noise on errors of rounding do not depend on each other


class MotorAngle(NamedTuple):
    """(N,) angle (rad) and the standard deviation (rad) of the noise that is left in it beyond its counts."""

    angle: Array
    noise: float


def without_noise(theta_m: Array, count: float) -> MotorAngle:
    """Smooth an angle (N,) that is noisier than its count (rad); otherwise leave it as it is."""
    spread = noise_of(theta_m)
    jitter = float(np.sqrt(max(0.0, spread**2 - count**2 / 12.0)))
    if jitter <= _DITHERED * count:
        return MotorAngle(theta_m, jitter)
    smooth, variance = _smooth(theta_m, spread)
    return MotorAngle(smooth, float(np.sqrt(np.mean(variance))))


def without_counts(theta_m: Array, count: float) -> Array:
    """Smooth an angle (N,) that comes in counts (rad) without other noise, within half a count of what it shows.

    A lag, as a delay by half a sample, averages errors of rounding that are left in, and fits better for that alone.
    """
    if count == 0.0:
        return theta_m
    between = between_counts(theta_m, count)
    smooth, _ = _smooth(between, max(noise_of(between), count * _EVENLY))
    return np.clip(smooth, theta_m - 0.5 * count, theta_m + 0.5 * count)


def _smooth(values: Array, std: float) -> tuple[Array, Array]:
    """(N,) values in noise of a standard deviation by parabolas to either side and both, and variances of that."""
    total, weight = np.zeros(values.size), np.zeros(values.size)
    for side in (-1, 0, 1):
        value, variance = _on_one_side(values, std, side)
        total += value / variance
        weight += 1.0 / variance
    return total / weight, 1.0 / weight


def noise_of(values: Array) -> float:
    """Standard deviation of the white noise of a smooth motion (N,), by what third differences leave of it."""
    return float(np.quantile(np.abs(np.diff(values, 3)), _ONE_STD)) / np.sqrt(20.0)


def _on_one_side(values: Array, std: float, side: int) -> tuple[Array, Array]:
    """(N,) values and variances of parabolas over the samples before (-1), after (1) or on both sides (0)."""
    best, variance, agreed = values.copy(), np.full(values.size, std**2), np.ones(values.size, dtype=bool)
    low, high = values - _INTERVAL * std, values + _INTERVAL * std
    for reach in _REACHES:
        before, after = reach * (side <= 0), reach * (side >= 0)
        if before + after >= values.size:
            break
        times = np.arange(-before, after + 1) / reach
        weights = np.linalg.pinv(np.vander(times, 3, increasing=True))[0]
        spread = std * float(np.linalg.norm(weights))
        fitted = np.full(values.size, np.nan)
        fitted[before : values.size - after] = np.correlate(values, weights, "valid")
        low, high = np.fmax(low, fitted - _INTERVAL * spread), np.fmin(high, fitted + _INTERVAL * spread)
        agreed &= np.isfinite(fitted) & (low <= high)
        best[agreed], variance[agreed] = fitted[agreed], spread**2
    return best, variance
