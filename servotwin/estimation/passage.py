"""First passage of a linear trend: the time until a gap that grows at an uncertain rate reaches a limit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servotwin.plant.signals import Array

_TAILS = (0.025, 0.5, 0.975)
_GRID = np.geomspace(1e-6, 1e6, 2401)  # times `_scale`


@dataclass(frozen=True)
class Passage:
    """The time from now until the gap reaches a limit.

    Attributes
    ----------
    median : float
        s; inf when it is more likely than not that it never does.
    interval : (float, float)
        s, 95 %; its upper end is inf unless the trend is sure to get there, which needs a rate whose sign is certain.
    probability : float
        Probability that it ever does.
    """

    median: float
    interval: tuple[float, float]
    probability: float


def passage(mean: Array, covariance: Array, gap: float, gap_walk: float = 0.0, rate_walk: float = 0.0) -> Passage:
    """First passage of gap + rate t through `gap`.

    The chance of having passed by t is taken as that of lying beyond now or at t. Without random walks it is exact;
    with them it misses the paths that passed and came back by t, which are rare because wear goes one way.

    Parameters
    ----------
    mean : (2,) array
        Gap (rad) and rate (rad/s) now.
    covariance : (2, 2) array
    gap : float
        The limit, rad.
    gap_walk, rate_walk : float
        rad/sqrt(s) and rad/s/sqrt(s): random walks of gap and rate.
    """

    def passed(time: Array) -> Array:
        return _passed(mean, covariance, gap, time, gap_variance=gap_walk**2, rate_variance=rate_walk**2)

    grid = _GRID * _scale(mean, covariance, gap)
    chance = np.maximum.accumulate(passed(np.concatenate([[0.0], grid])))
    early, median, late = (_quantile(passed, grid, chance, tail) for tail in _TAILS)
    return Passage(median, (early, late), float(chance[-1]))


def _scale(mean: Array, covariance: Array, gap: float) -> float:
    """Time scale of the passage: distance over rate, spreads included; 1 s when nothing moves."""
    distance = abs(gap - float(mean[0])) + math.sqrt(covariance[0, 0])
    rate = abs(float(mean[1])) + math.sqrt(covariance[1, 1])
    # The limits keep the powers of the time in `_passed` finite.
    return min(max(distance / rate, 1e-60), 1e60) if rate > 0.0 and distance > 0.0 else 1.0


def _quantile(passed: Callable[[Array], Array], grid: Array, chance: Array, tail: float) -> float:
    """First time at which the chance reaches `tail`; inf if it never does."""
    index = int(np.searchsorted(chance, tail))
    if index == 0:
        return 0.0
    if index == chance.size:
        return math.inf
    # scipy.optimize and scipy.special take a third of a second to import: here, for the processes that never need them.
    from scipy.optimize import brentq

    begin, end = 0.0 if index == 1 else float(grid[index - 2]), float(grid[index - 1])
    return float(brentq(lambda t: float(passed(np.array([t]))[0]) - tail, begin, end, xtol=1e-12 * end))


def _passed(
    mean: Array, covariance: Array, gap: float, time: Array, gap_variance: float, rate_variance: float
) -> Array:
    """Chance of lying beyond `gap` now or at each `time` (n,); the walks' variances grow per second."""
    now, cross, rate = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    then = now + 2.0 * time * cross + time**2 * rate + gap_variance * time + rate_variance * time**3 / 3.0
    shared = now + time * cross
    first = _score(gap - float(mean[0]), np.full_like(time, now))
    second = _score(gap - float(mean[0]) - time * float(mean[1]), then)
    product = np.sqrt(now * np.maximum(then, 0.0))
    correlation = np.divide(shared, product, out=np.zeros_like(time), where=product > 0.0)
    # Rounding may put a correlation a little beyond 1.
    return 1.0 - both_below(first, second, np.clip(correlation, -1.0, 1.0))


def _score(distance: Array | float, variance: Array) -> Array:
    """distance / sqrt(variance), infinite with the distance's sign where there is no variance (at 0: passed)."""
    far = np.where(np.asarray(distance) > 0.0, math.inf, -math.inf) * np.ones_like(variance)
    return np.divide(distance, np.sqrt(np.maximum(variance, 0.0)), out=far, where=variance > 0.0)


def both_below(h: Array, k: Array, correlation: Array) -> Array:
    """(n,) chance that two standard normals of the given correlation lie below h and below k (Owen, 1956)."""
    from scipy.special import ndtr

    left = np.sqrt(1.0 - correlation**2)
    smooth = (left > 0.0) & np.isfinite(h) & np.isfinite(k)
    safe_h, safe_k = np.where(smooth, h, 1.0), np.where(smooth, k, 1.0)
    owen = _owen(safe_h, safe_k, np.where(smooth, correlation, 0.0))
    sure = np.where(correlation < 0.0, np.maximum(0.0, ndtr(h) + ndtr(k) - 1.0), ndtr(np.minimum(h, k)))
    apart = np.where(np.isfinite(h) & np.isfinite(k), sure, ndtr(np.minimum(h, k)))
    return np.clip(np.where(smooth, owen, apart), 0.0, 1.0)


def _owen(h: Array, k: Array, correlation: Array) -> Array:
    from scipy.special import ndtr, owens_t

    left = np.sqrt(1.0 - correlation**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_h, by_k = (k / h - correlation) / left, (h / k - correlation) / left
    origin = np.sqrt((1.0 - correlation) / (1.0 + correlation))
    by_h = np.where((h == 0.0) & (k == 0.0), origin, by_h)
    by_k = np.where((h == 0.0) & (k == 0.0), origin, by_k)
    opposite = (h * k < 0.0) | ((h * k == 0.0) & (h + k < 0.0))
    return 0.5 * (ndtr(h) + ndtr(k)) - owens_t(h, by_h) - owens_t(k, by_k) - np.where(opposite, 0.5, 0.0)
