"""Search for the best fit of a window: a grid of gaps and offsets, then minima beside the best, then in its noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Protocol, cast

import numpy as np

from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.output_error.fit import (
    Fit,
    FitProblem,
    Search,
    descend,
    noise_in,
    only_rounding,
    plain_cost,
)
from servotwin.estimation.output_error.models import HALF, OFFSET
from servotwin.plant.signals import Array

_GENTLY = 0.7  # of a rate of the observer: the next one, at least
_STEPS, _LAST_STEPS = 10, 20  # in white noise, at each rate
_ROUGH = 1e-3  # of the cost: what a step in white noise must promise
_FIRST, _KEPT = 6, 3  # minima that are followed from the first rate on, and from the second
_LOW = 0.1  # the white noise, of what the best minimum before has left
_ROUNDED_STEPS, _LEARNT_STEPS, _PASSES = 20, 20, 3
_SAME = 0.02  # of a gap: minima that are one
_NEIGHBOURS, _NEAR = 16, (0.01, 0.5)  # places beside the best minimum that are tried, and how far of the half gap
_LEFT, LEFT_COUNTS, _WHITE = 0.001, 0.33, 1.2  # of half the gap, a count, white noise: what a good fit leaves


class SearchProblem(FitProblem, Protocol):
    """A window and a model of it, with starts beside the unknowns (u,) of another fit: another first state."""

    def beside(self, values: Array) -> list[Array]: ...


def starts(problem: FitProblem, gap: float) -> list[Array]:
    """Unknowns (u,) of a grid of gaps and offsets, the best ones of different gaps first.

    Parameters
    ----------
    problem : FitProblem
    gap : float
        Half gap at the load that is expected; 0: none.
    """
    best = []
    for tried in problem.grid(gap):
        costs = [plain_cost(problem, values, problem.model.speed) for values in tried]
        best.append((min(costs), tried[int(np.argmin(costs))]))
    return [values for _, values in sorted(best, key=lambda pair: pair[0])]


def search(problem: SearchProblem, gap: float) -> Search:
    """Fit a window: `gap` as in `starts`.

    Minima are compared by all that they leave. Noise that was learnt at a wrong minimum makes what that leaves look
    likely, and hides the others: it is learnt at the one that leaves least.
    """
    rounded = _in_rounding(problem, gap)
    if rounded is not None:
        return rounded
    fits = _in_white_noise(problem, starts(problem, gap))
    return _in_own_noise(problem, [_beside(problem, fits[0]), *fits])


def also_from(found: Search, values: Array) -> Search:
    """The search with one more start, at unknowns (u,) within their limits; as it is where that does not leave less."""
    problem = cast(SearchProblem, found.problem)
    start, rate = np.clip(values, -problem.limits(), problem.limits()), _last_rate(problem)
    noise = _white(problem, min(plain_cost(problem, start, rate), _left(found.best)))
    fit = descend(problem, start, noise, problem.free, _LAST_STEPS, rate, _ROUGH)
    return found if _left(fit) >= _left(found.best) else _in_own_noise(problem, [fit, found.best, *found.others])


def _in_own_noise(problem: SearchProblem, fits: list[Fit]) -> Search:
    """Fits from minima in the noise that the first of them leaves, which is learnt anew at the best one."""
    for _ in range(_PASSES):
        noise = noise_in(problem, fits[0])
        fits = [descend(problem, fit.values, noise, problem.free, _LEARNT_STEPS, _last_rate(problem)) for fit in fits]
        fits = distinct(sorted(fits, key=lambda fit: fit.cost))
    return Search(problem, noise, fits[0], tuple(fits[1:]), problem.free)


def _last_rate(problem: FitProblem) -> float:
    """Of the observer, 1/s."""
    return problem.model.slowing[-1] * problem.model.speed


def _left(fit: Fit) -> float:
    """Sum of squares of what a fit leaves; inf where the load ran away."""
    with np.errstate(over="ignore"):
        left = float(fit.raw @ fit.raw)
    return left if math.isfinite(left) else math.inf


def one_flank_without_a_gap(found: Search) -> Iterator[Fit]:
    """Fits with one flank, in the found noise, of a window whose best fit has hardly a gap.

    The noise of the best fit hides them (`search`): they are followed in white noise, as that fit was.
    """
    problem, free = cast(SearchProblem, found.problem), found.free.copy()
    free[HALF] = False
    noise = _white(problem, _left(found.best))
    for tried in problem.on_one_flank(found.best.values):
        values = min(tried, key=lambda each: plain_cost(problem, each, problem.model.speed))
        for rate in _rates(problem):
            values = descend(problem, _nearest(problem, values, rate), noise, free, _STEPS, rate, _ROUGH).values
        for steps in (0, _STEPS):
            yield descend(problem, values, found.noise, free, steps, _last_rate(problem))


def distinct(fits: list[Fit]) -> list[Fit]:
    """Fits in different gaps, the best of each."""
    chosen: list[Fit] = []
    for fit in fits:
        if all(abs(fit.values[HALF] - one.values[HALF]) > _SAME * one.values[HALF] for one in chosen):
            chosen.append(fit)
    return chosen


def _white(problem: FitProblem, left: float) -> Autoregression:
    """White noise that is a small share of what a fit has left, a sum of squares."""
    rms = math.sqrt(left / problem.position.size)
    return Autoregression.white(max(_LOW * rms, 1e-9 * problem.range) if math.isfinite(rms) else problem.range)


def _in_white_noise(problem: SearchProblem, tried: list[Array]) -> list[Fit]:
    """Minima from starts in white noise, under an observer that slows down; the one that leaves least first.

    The slower the observer, the more the load's motion after many contacts tells, and the rougher is the cost.
    """
    left = plain_cost(problem, tried[0], problem.model.speed)
    fits, rates = list[Fit](), _rates(problem)
    for i, rate in enumerate(rates):
        noise, steps = _white(problem, left), _LAST_STEPS if i + 1 == len(rates) else _STEPS
        tried = [_nearest(problem, values, rate) for values in tried]
        fits = [descend(problem, values, noise, problem.free, steps, rate, _ROUGH) for values in tried]
        fits = distinct(sorted(fits, key=_left))[: _KEPT if i else _FIRST]
        tried, left = [fit.values for fit in fits], _left(fits[0])
    return fits


def _rates(problem: FitProblem) -> list[float]:
    """Of the observer as it slows down, 1/s, the last one twice if it does not."""
    last = problem.model.slowing[-1]
    count = max(1, math.ceil(math.log(last) / math.log(_GENTLY)))
    return [problem.model.speed * last ** (i / count) for i in range(count + 1)]


def _nearest(problem: SearchProblem, values: Array, rate: float) -> Array:
    """Unknowns (u,), with a first state by the window's begin where that leaves less.

    A fast observer forgets the first state, and its fit leaves it anywhere: a slower one would begin far off.
    """
    return min((values, *problem.beside(values)), key=lambda each: plain_cost(problem, each, rate))


def _beside(problem: SearchProblem, best: Fit) -> Fit:
    """The best of a minimum and of some beside it.

    Every contact that comes earlier or later makes minima of its own: where a fit leaves more than rounding, gaps and
    offsets near it are tried.
    """
    random = np.random.default_rng(0)
    for _ in range(_NEIGHBOURS):
        if explains(problem, best):
            break
        far = math.exp(random.uniform(math.log(_NEAR[0]), math.log(_NEAR[1])))
        values, noise = best.values.copy(), _white(problem, _left(best))
        values[HALF] *= math.exp(far * random.normal())
        values[OFFSET] += far * values[HALF] * random.normal()
        for share in problem.model.slowing:
            rate = share * problem.model.speed
            fit = descend(problem, _nearest(problem, values, rate), noise, problem.free, _LEARNT_STEPS, rate, _ROUGH)
            values = fit.values
        best = min(best, fit, key=_left)
    return best


def explains(problem: FitProblem, fit: Fit, counts: float = LEFT_COUNTS) -> bool:
    """Tell whether a fit leaves next to nothing, so many counts of the sensor, or white noise."""
    white = _WHITE * math.sqrt(0.5) * rms(np.diff(fit.raw))
    return rms(fit.raw) <= max(_LEFT * float(fit.values[HALF]), counts * problem.count, white)


def rms(raw: Array) -> float:
    """Root mean square of what a fit leaves (N,); inf where the load ran away."""
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(raw**2)))


def _in_rounding(problem: FitProblem, gap: float) -> Search | None:
    """Fit of a window in errors of rounding; None where they do not explain it, and other noise is to be learnt."""
    if problem.model.speed > 0.0 or problem.count == 0.0:
        return None
    noise = Autoregression.white(problem.count / math.sqrt(12.0))
    fits = [descend(problem, values, noise, problem.free, _ROUNDED_STEPS) for values in starts(problem, gap)]
    fits = distinct(sorted(fits, key=lambda fit: fit.cost))
    return Search(problem, noise, fits[0], tuple(fits[1:]), problem.free) if only_rounding(problem, fits[0]) else None
