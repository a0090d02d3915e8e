"""Search for the best fit of a window from the motor's side: in the noise that the first minima leave.

Friction that the model does not know is most of what any fit leaves here. Minima compared by all that they leave, as
`output_error.search` does, were worse: of eight windows of `two-mass-drive` (seed 1128) one was accepted, and three
are here.
"""

from __future__ import annotations

import math

from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.output_error.fit import Fit, FitProblem, Search, descend, noise_in, plain_cost
from servotwin.estimation.output_error.search import distinct, starts
from servotwin.plant.signals import Array

_FIRST, _KEPT = 4, 2  # minima that are followed in white noise, and in the window's own
_WHITE, _SLOWER, _SLOWEST = 10, 8, 10  # steps in white noise, and in the learnt one as the observer slows down
_LOW = 0.3  # the white noise, of what the best start leaves
_PASSES = 3
_AGAIN = ((3, 3), (10, 2))  # steps in the noise that was learnt, from each start of the grid, and minima kept


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
    return Search(problem, noise, fits[0], tuple(fits[1:]), problem.free)


def _white_noise(problem: FitProblem, start: Array) -> Autoregression:
    """White noise that is a share of what a start leaves."""
    left = math.sqrt(plain_cost(problem, start, problem.model.speed) / problem.position.size)
    return Autoregression.white(max(_LOW * left, 1e-9 * problem.range))


def _followed(problem: FitProblem, begun: list[Array], noise: Autoregression, steps: int, rate: float) -> list[Fit]:
    """Minima from unknowns (u,) at a rate of the observer (1/s), the cheapest first."""
    return _ranked([descend(problem, values, noise, problem.free, steps, rate) for values in begun])


def _ranked(fits: list[Fit]) -> list[Fit]:
    return sorted(fits, key=lambda fit: fit.cost)


def _values(fits: list[Fit]) -> list[Array]:
    """Unknowns (u,) of the best fits in different gaps."""
    return [fit.values for fit in distinct(fits)[:_KEPT]]
