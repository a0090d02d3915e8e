"""Search for the best fit of a window from the motor's side: in the noise that the first minima leave.

Friction that the model does not know is most of what any fit leaves here. Minima compared by all that they leave, as
`output_error.search` does, were worse: of eight windows of `two-mass-drive` (seed 1128) one was accepted, and three
are here.
"""

from __future__ import annotations

import math

from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.output_error.fit import Fit, FitProblem, Search, descend, noise_in, plain_cost
from servotwin.estimation.output_error.models import HALF
from servotwin.estimation.output_error.search import distinct, explains, rms, starts
from servotwin.plant.signals import Array

_FIRST, _KEPT = 4, 2  # minima that are followed in white noise, and in the window's own
_WHITE, _SLOWER, _SLOWEST = 10, 8, 10  # steps in white noise, and in the learnt one as the observer slows down
_LOW = 0.3  # the white noise, of what the best start leaves
_PASSES = 3
_AGAIN = ((3, 3), (10, 2))  # steps in the noise that was learnt, from each start of the grid, and minima kept
_BESIDE = (0.02, -0.02, 0.05, -0.05, 0.07, -0.07, 0.1, -0.1)  # of the gap: starts where the best minimum leaves much
_BESIDE_STEPS, _SHARES = 15, (1.0, 0.5, 0.3, 0.15)  # from each, as the observer slows down
_LEFT_COUNTS = 1.0  # what a good fit leaves
_LESS = 0.5  # of what the best minimum leaves: one beside it leaves less for certain
_BENT = 1.0  # squared standard deviations: how much less usual the numbers of that one may be


def search(problem: FitProblem, gap: float) -> Search:
    """Fit a window: `gap` as in `starts`."""
    tried = starts(problem, gap)
    speed, slower, slowest = (share * problem.model.speed for share in (1.0, *problem.model.slowing))
    fits = _followed(problem, tried[:_FIRST], _white_noise(problem, tried[0]), _WHITE, speed)
    fits = _followed(problem, _values(fits), noise_in(problem, fits[0]), _SLOWER, slower)
    for _ in range(_PASSES):
        noise = noise_in(problem, fits[0])
        fits = _followed(problem, _values(fits), noise, _SLOWEST, slowest)
    # Minima that were followed from white noise on can have led the model's numbers astray: these begin at its own.
    again, values = fits, tried
    for steps, kept in _AGAIN:
        again = distinct(_followed(problem, values, noise, steps, slowest))[:kept]
        values = [fit.values for fit in again]
    if again[0].cost < fits[0].cost:
        # The noise was learnt from what a worse minimum had left.
        noise = noise_in(problem, again[0])
        again = _followed(problem, _values(again), noise, _SLOWEST, slowest)
        fits = _followed(problem, [fit.values for fit in fits], noise, _SLOWEST, slowest)
    fits = distinct(_ranked([*fits, *again]))
    beside = _beside(problem, fits[0])
    if beside is not None:
        found = [beside, *fits]
        for _ in range(_PASSES):
            noise = noise_in(problem, found[0])
            found = _followed(problem, [fit.values for fit in found], noise, _SLOWEST, slowest)
        fits = distinct(found)
    return Search(problem, noise, fits[0], tuple(fits[1:]), problem.free)


def _beside(problem: FitProblem, best: Fit) -> Fit | None:
    """The minimum beside the best one that leaves far less; None: there is none, or little is left.

    A contact that comes earlier or later makes a minimum of its own, where the model's numbers go astray. Starts beside
    it begin at the model's own numbers, in white noise, under an observer that slows down. In such noise the numbers
    bend to leave less in any minimum: one whose numbers are less usual says nothing.
    """
    found = best
    for share in _BESIDE:
        if explains(problem, found, _LEFT_COUNTS):
            break
        *_, tried = problem.grid(float(best.values[HALF]) * (1.0 + share))
        values = min(tried, key=lambda each: plain_cost(problem, each, problem.model.speed))
        left = math.sqrt(plain_cost(problem, values, problem.model.speed) / problem.position.size)
        for slower in _SHARES:
            noise, rate = _low(problem, left), slower * problem.model.speed
            fit = descend(problem, values, noise, problem.free, _BESIDE_STEPS, rate)
            values, left = fit.values, rms(fit.raw)
        found = min(found, fit, key=lambda each: rms(each.raw))
    straight = _unusual(problem, found) <= _unusual(problem, best) + _BENT
    return found if straight and rms(found.raw) < _LESS * rms(best.raw) else None


def _unusual(problem: FitProblem, fit: Fit) -> float:
    """Squared distance of a fit's numbers from those of the model, in their standard deviations."""
    away = problem.model.root @ fit.values
    return float(away @ away)


def _white_noise(problem: FitProblem, start: Array) -> Autoregression:
    """White noise that is a share of what a start leaves."""
    return _low(problem, math.sqrt(plain_cost(problem, start, problem.model.speed) / problem.position.size))


def _low(problem: FitProblem, left: float) -> Autoregression:
    """White noise that is a share of what is left (root mean square)."""
    return Autoregression.white(max(_LOW * left, 1e-9 * problem.range) if math.isfinite(left) else problem.range)


def _followed(problem: FitProblem, begun: list[Array], noise: Autoregression, steps: int, rate: float) -> list[Fit]:
    """Minima from unknowns (u,) at a rate of the observer (1/s), the cheapest first."""
    return _ranked([descend(problem, values, noise, problem.free, steps, rate) for values in begun])


def _ranked(fits: list[Fit]) -> list[Fit]:
    return sorted(fits, key=lambda fit: fit.cost)


def _values(fits: list[Fit]) -> list[Array]:
    """Unknowns (u,) of the best fits in different gaps."""
    return [fit.values for fit in distinct(fits)[:_KEPT]]
