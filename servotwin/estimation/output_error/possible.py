"""Gaps that a window leaves possible, for a motion without dynamics.

The window is fitted at many gaps, and each counts by how well it explains the window. The best fit and its curvature do
not do: a motor that creeps to its places with one rate makes the same motion of the load with another gap, ratio and
delay, so that only what is known of these tells the gaps apart, and noise makes many minima along that valley.

Where rounding is all of the noise, its errors depend on each other in a motor that creeps, or repeats its motion: with
ratio and delay free the best fit of one such motion was 27 % off, for residuals that were a hundredth smaller, and at
the true numbers the squares of another were an eighth larger than at the best ones. They count as few independent
errors there, however many samples there are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from servotwin.estimation.output_error.fit import Fit, Search, descend, only_rounding
from servotwin.estimation.output_error.models import DELAY, HALF, RATIO, Flags
from servotwin.estimation.output_error.search import rms
from servotwin.plant.signals import Array

_COARSEST, _FINEST, _GROWTH = 0.01, 0.01, 1.15  # steps from one gap to the next: of the best gap; of that; growth
_WIDEST, _NARROWEST = 2.0, 0.99  # times the best gap: the farthest ones, and how far smaller ones are from it
_HIDDEN, _PART = 2.0, 0.01  # times what the best fit leaves: gaps that it may hide; of that: a step, where that is more
_STEPS, _DEEPER = 15, 8
_BELL = math.sqrt(2.0 * math.pi)  # standard deviations: width of a normal distribution over its height
INDEPENDENT = 30.0  # errors of rounding; from 10 to 100 no accepted gap of 120 windows was outside its interval
_IMPOSSIBLE = 200.0  # rise of the cost in noise, over its variance; in rounding the cost doubles
_WALL = 0.1  # of that rise: what may be a wall
_PATIENCE = 3.0  # steps


class PossibleHalf(NamedTuple):
    """Half gap that a window leaves possible, m or rad at the load: mean and standard deviation.

    Attributes
    ----------
    mean, std : float
    unknowns : (u,) array
        Means of all unknowns.
    ratio_std : float
        Standard deviation of the logarithm of the transmission's ratio.
    covariance : float
        Of the half gap and that logarithm.
    """

    mean: float
    std: float
    unknowns: Array
    ratio_std: float
    covariance: float

    @property
    def ratio(self) -> float:
        """Logarithm of the transmission's ratio over the model's."""
        return float(self.unknowns[RATIO])

    @property
    def slope(self) -> float:
        """Change of the half gap per change of the ratio's logarithm, m or rad at the load."""
        return self.covariance / self.ratio_std**2

    @property
    def std_with_ratio(self) -> float:
        """Standard deviation of the half gap if the ratio were known."""
        return math.sqrt(max(0.0, self.std**2 - self.slope * self.covariance))


def possible_half(found: Search) -> PossibleHalf | None:
    """Weigh the half gaps by how well they explain a window; None for a model with dynamics."""
    if found.problem.model.speed > 0.0:
        return None
    rounding = only_rounding(found.problem, found.best)
    rise = found.best.cost if rounding else _IMPOSSIBLE * found.best.variance()
    fits = [*reversed(list(_profile(found, -1.0, rise))), found.best, *_profile(found, 1.0, rise)]
    halves = np.array([fit.values[HALF] for fit in fits])
    widths = np.gradient(halves) if halves.size > 1 else np.ones(1)
    if rounding:
        weights = widths * _in_rounding(found, fits)
    else:
        fits = [_deepest(found, fit, width) for fit, width in zip(fits, widths, strict=True)]
        halves = np.array([fit.values[HALF] for fit in fits])
        widths = np.minimum(widths, [_BELL * fit.std(HALF, found.free) for fit in fits])
        weights = widths * _in_noise(found, fits)
    weights /= weights.sum()
    values = np.array([fit.values for fit in fits])
    mean, std = _moments(weights, halves, widths / math.sqrt(12.0))
    ratios = values[:, RATIO]
    ratio, ratio_std = _moments(weights, ratios, np.array([_ratio_std(found, fit, rounding) for fit in fits]))
    covariance = float(weights @ ((halves - mean) * (ratios - ratio)))
    return PossibleHalf(mean, std, weights @ values, ratio_std, covariance)


def _moments(weights: Array, values: Array, spreads: Array) -> tuple[float, float]:
    """Mean and standard deviation of values (f,) that have spreads of their own."""
    mean = float(weights @ values)
    return mean, math.sqrt(float(weights @ ((values - mean) ** 2 + spreads**2)))


def _ratio_std(found: Search, fit: Fit, rounding: bool) -> float:
    """Standard deviation of the ratio's logarithm at the half gap of a fit."""
    free = found.free.copy()
    free[HALF] = False
    std, known = fit.std(RATIO, free), found.problem.model.unknowns[RATIO].std
    if not rounding:
        return std
    told = max(0.0, std**-2 - known**-2) * min(1.0, INDEPENDENT / fit.raw.size)
    return 1.0 / math.sqrt(told + known**-2)


def _deepest(found: Search, fit: Fit, width: float) -> Fit:
    """The minimum near a fit with a given half gap, where it is narrower than the gaps that the fit stands for."""
    full = descend(found.problem, fit.values, found.noise, found.free, 0)
    if full.std(HALF, found.free) > width:
        return full
    lower = descend(found.problem, fit.values, found.noise, found.free, _DEEPER)
    return lower if abs(lower.values[HALF] - fit.values[HALF]) <= width else full


def _in_rounding(found: Search, fits: list[Fit]) -> Array:
    """(f,) likelihoods of fits in a few independent normal errors of unknown size, over that of the best."""
    prior = np.array([_prior(found, fit) for fit in fits])
    misfit = np.array([fit.cost for fit in fits]) - prior
    likely = -0.5 * (INDEPENDENT * np.log(misfit) + prior)
    return np.exp(likely - likely.max())


def _in_noise(found: Search, fits: list[Fit]) -> Array:
    """(f,) likelihoods of fits in normal noise, over that of the best."""
    costs = np.array([fit.cost for fit in fits])
    return np.exp(-0.5 * (costs - costs.min()) / found.best.variance())


def _profile(found: Search, side: float, rise: float) -> Iterator[Fit]:
    """Fits at half gaps ever farther from the best one, smaller (-1) or larger (1), each from the one before.

    They end where none of the last ones has cost less than `rise` more than the best. Minima a sample of delay apart
    have walls between them where the motor's speed jumps.
    """
    free, best, beyond = found.free.copy(), float(found.best.values[HALF]), _beyond(found)
    free[HALF] = False
    farthest = max(_WIDEST * best, best + beyond) - best if side > 0.0 else _NARROWEST * best
    coarsest = max(_COARSEST * best, _PART * beyond)
    fit, away, likely = found.best, 0.0, 0.0
    step = min(coarsest, max(_FINEST * coarsest, found.best.std(HALF, found.free)))
    while away < min(farthest, likely + _PATIENCE * coarsest):
        away, step = min(farthest, away + step), min(coarsest, _GROWTH * step)
        start = fit.values.copy()
        start[HALF] = best + side * away
        fit = descend(found.problem, start, found.noise, free, _STEPS)
        if fit.cost > found.best.cost + _WALL * rise:
            fit = min((fit, *_a_sample_away(found, fit, free)), key=lambda one: one.cost)
        likely = away if fit.cost < found.best.cost + rise else likely
        yield fit


def _beyond(found: Search) -> float:
    """Distance (m or rad at the load) of half gaps that noise of the position may hide, however small the best one."""
    return _HIDDEN * rms(found.best.raw)


def _a_sample_away(found: Search, fit: Fit, free: Flags) -> Iterator[Fit]:
    """Fits at the same half gap with a delay of a sample less or more."""
    for samples in (-1.0, 1.0):
        start = fit.values.copy()
        start[DELAY] += samples * found.problem.interval
        yield descend(found.problem, start, found.noise, free, _STEPS)


def _prior(found: Search, fit: Fit) -> float:
    """Squares of how far the model's numbers are off what is known of them, in standard deviations, summed."""
    spreads = np.array([unknown.std for unknown in found.problem.model.unknowns])
    return float(np.sum((fit.values / spreads) ** 2))
