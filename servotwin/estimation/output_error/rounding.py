"""Gaps that the rounding of the encoders leaves possible, for a motion without dynamics.

Play turns an error of the motor's angle into one that is no larger, so that at the true unknowns no residual exceeds
half a count of each channel together. Least squares does not know that. Errors of a motor that creeps, or repeats its
motion, depend on each other: with ratio and delay free the best fit of one such motion was 27 % off, for residuals that
were a hundredth smaller. So the window is fitted at many gaps, and all count whose residuals keep to the bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from servotwin.estimation.output_error.fit import Fit, Search, descend, only_rounding
from servotwin.estimation.output_error.models import HALF

_FINEST, _COARSEST, _GROWTH = 1e-4, 0.01, 1.15  # steps from one gap to the next, of the gap, and their growth
_WIDEST = 2.0  # factor between the best gap and the farthest ones
_STEPS = 15
_SLACK = 1.1  # of the bound: least squares does not make the largest residual small
_FAR = 10.0  # bounds: no gap beyond is possible


class PossibleHalf(NamedTuple):
    """Half gap that rounding leaves possible, m or rad at the load: mean and standard deviation."""

    mean: float
    std: float


def possible_half(found: Search, bound: float) -> PossibleHalf | None:
    """Weigh the half gaps at which all residuals keep to a bound; None where rounding does not explain the best fit.

    Parameters
    ----------
    found : Search
        Of a model without dynamics.
    bound : float
        Largest error that rounding makes, m or rad at the load. Where no fit keeps to it the model errs too, and the
        least largest residual takes its place.
    """
    if bound <= 0.0 or not only_rounding(found.problem, found.best):
        return None
    fits = [*reversed(list(_profile(found, -1.0, bound))), found.best, *_profile(found, 1.0, bound)]
    halves = np.array([fit.values[HALF] for fit in fits])
    largest = np.array([_largest(fit) for fit in fits])
    widths = np.gradient(halves) if halves.size > 1 else np.ones(1)
    likely = np.exp(-0.5 * np.array([_prior(found, fit) for fit in fits]))
    weights = widths * likely * (largest <= _SLACK * max(bound, float(largest.min())))
    weights /= weights.sum()
    mean = float(weights @ halves)
    return PossibleHalf(mean, math.sqrt(float(weights @ ((halves - mean) ** 2 + widths**2 / 12.0))))


def _profile(found: Search, side: float, bound: float) -> Iterator[Fit]:
    """Fits at half gaps ever farther from the best one, smaller (-1) or larger (1), each from the one before."""
    free, best = found.free.copy(), float(found.best.values[HALF])
    free[HALF] = False
    values, share = found.best.values, 0.0
    step = min(_COARSEST, max(_FINEST, found.best.std(HALF, found.free) / best))
    while share < math.log(_WIDEST):
        share, step = share + step, min(_COARSEST, _GROWTH * step)
        start = values.copy()
        start[HALF] = best * math.exp(side * share)
        fit = descend(found.problem, start, found.noise, free, _STEPS)
        if _largest(fit) > _FAR * bound:
            return
        values = fit.values
        yield fit


def _largest(fit: Fit) -> float:
    return float(np.max(np.abs(fit.raw)))


def _prior(found: Search, fit: Fit) -> float:
    """Squares of how far the model's numbers are off what is known of them, in standard deviations, summed."""
    spreads = np.array([unknown.std for unknown in found.problem.model.unknowns])
    return float(np.sum((fit.values / spreads) ** 2))
