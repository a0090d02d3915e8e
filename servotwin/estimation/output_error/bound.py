"""Lower bound of a gap: the smallest one that a window does not exclude."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from servotwin.estimation.output_error.fit import Fit, Search, descend
from servotwin.estimation.output_error.models import HALF, OFFSET
from servotwin.estimation.output_error.search import rms
from servotwin.estimation.output_error.unexplained import slow_error
from servotwin.plant.signals import Array

_EXCLUDED = 30.0  # rise of the cost, over the noise's variance
_HARDLY = 0.1  # of a count: rms beyond that of the best fit
# Times the slow motion that the best fit leaves. With 2.5 times the load's inertia the true gap left 2.7 times as much
# as one that was 6 times as wide.
_OTHER_MACHINE = 5.0
_SHARES = (0.0, 0.15, 0.3, 0.45, 0.6, 0.7, 0.8, 0.9)  # of a gap that explains the window
_HALVINGS = 2  # of the last step between two shares
_STEPS = 8


def smallest_half(found: Search, single: Fit) -> float:
    """Half gap (m or rad at the load) below which every one is excluded; 0 where the window excludes none.

    Gaps from 0 up are fitted with all else free. The one at which they begin to explain the window counts, and not the
    way that the motor is off a flank in the best fit: a delay, a ratio or wind-up can take the place of that way.

    Parameters
    ----------
    found : Search
    single : Fit
        The best one in which the motor touches one flank only.
    """
    likely, limit = likely_fits(found, single)
    # One flank is the same whatever is beyond the motor's way.
    top = min([0.5 * found.problem.range, *(float(fit.values[HALF]) for fit in likely)])
    below, above = 0.0, top
    for share in _SHARES:
        if _explains(found, share * top, likely, limit):
            above = share * top
            break
        below = share * top
    for _ in range(_HALVINGS if below > 0.0 else 0):
        middle = 0.5 * (below + above)
        if _explains(found, middle, likely, limit):
            above = middle
        else:
            below = middle
    return below


def likely_fits(found: Search, single: Fit) -> tuple[list[Fit], float]:
    """Minima that explain a window, the best one with one flank among them, and the largest cost of such a fit."""
    fits = [found.best, single, *found.others]
    limit = min(fit.cost for fit in fits) + _EXCLUDED * found.best.variance()
    return [fit for fit in fits if fit.cost <= limit], limit


def _explains(found: Search, half: float, like: list[Fit], limit: float) -> bool:
    """True where a fit with a given half gap costs no more than a limit, or leaves hardly more than the best fit.

    The noise was learnt at the best fit, and speaks for it: below a share of a count it is no evidence. Where the best
    fit leaves slow motion, the model is not the machine's, and its other gaps may leave some times as much.
    """
    least = max(math.hypot(rms(found.best.raw), _HARDLY * found.problem.count), _OTHER_MACHINE * _beyond_a_count(found))
    return any(fit.cost <= limit or rms(fit.raw) <= least for fit in _fits_at(found, half, like))


def _beyond_a_count(found: Search) -> float:
    """rms (m or rad at the load) of slow motion that the best fit leaves, without what a count may be."""
    return math.sqrt(max(0.0, slow_error(found) ** 2 - found.problem.count**2))


def _fits_at(found: Search, half: float, like: list[Fit]) -> Iterator[Fit]:
    """Fits with a given half gap, from those of other gaps with one of their flanks kept, and from the grid."""
    problem, free = found.problem, found.free.copy()
    rate = problem.model.slowing[1] * problem.model.speed
    free[HALF] = False
    made = [_with_flank(fit.values, half, side) for fit in like for side in (-1.0, 1.0)]
    grid = [_with_flank(values, half, 0.0) for values in problem.grid(0.0)[0]]
    made.append(min(grid, key=lambda values: float(np.sum(problem.misfit(values, rate) ** 2))))
    return (descend(problem, values, found.noise, free, _STEPS, rate) for values in made)


def _with_flank(values: Array, half: float, side: float) -> Array:
    """Unknowns (u,) with another half gap, whose flank on a side stays."""
    made = values.copy()
    made[OFFSET] += side * (half - values[HALF])
    made[HALF] = half
    return made
