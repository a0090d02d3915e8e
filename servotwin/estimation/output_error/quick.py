"""Quick fit of a window beside another window of the same machine, a tenth to a hundredth of the whole estimate's time.

It tells whether the gap has moved; the estimator tells where to. What a window has in common with the one that was
estimated last (delay, ratio, numbers of shaft and load) is taken from there; gap and offset are fitted, and then the
load's first motion too, which begins as the first samples show.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.output_error.estimator import problem_of
from servotwin.estimation.output_error.fit import Fit, Search, descend, noise_in
from servotwin.estimation.output_error.held_chain import lever
from servotwin.estimation.output_error.models import HALF, Flags
from servotwin.estimation.output_error.rounding import rounded
from servotwin.estimation.output_error.search import SearchProblem
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.whitened.quick import QuickFit
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array

_KEPT = 3  # places of the load in the gap that are followed
_STEPS, _MANY_STEPS, _PASSES = 6, 10, 2
_QUIETER = 0.3  # of what a start leaves: noise in which the first fit descends
_ROUNDED = 1.0 / 3.0  # of a count: what rounding leaves is no less
_LAST_STEP = 0.3  # standard deviations: largest last step of a gap that has converged


class QuickProblem(SearchProblem, Protocol):
    """A window and a model of it, with starts (u,) at a half gap."""

    def places(self, half: float) -> list[Array]: ...


class SpreadParts(NamedTuple):
    """Parts of the spread of a quick fit.

    Attributes
    ----------
    noise : float
        Times the computed standard deviation.
    share, counts : float
        Of the half gap, and counts: the part that every window has.
    """

    noise: float
    share: float
    counts: float


_OWN = OutputErrorSettings()
_SPREAD = SpreadParts(_OWN.calibration, _OWN.model_share, 0.25)  # a quarter of a count: half a count of the whole gap


def quick_fit(window: Window, axis: Axis, unknowns: Array, machine: FactorPrior | None = None) -> QuickFit:
    """Fit gap and offset of a window; raises InvalidInput as the estimator does, and for unknowns of another model.

    Parameters
    ----------
    window : Window
    axis : Axis
    unknowns : (u,) array
        As `unknowns_at` found them in another window of the same machine.
    machine : FactorPrior, optional
        What is known of the machine, as for the other window.
    """
    problem, known = problem_of(window, axis, machine)
    return fit_beside(problem, unknowns, 2.0 / lever(known), _SPREAD)


def unknowns_at(window: Window, axis: Axis, gap: float, machine: FactorPrior | None = None) -> Array:
    """Unknowns (u,) of a window whose total gap (rad) was estimated; raises InvalidInput as the estimator does."""
    problem, known = problem_of(window, axis, machine)
    return unknowns_in(problem, 0.5 * lever(known) * gap)


def fit_beside(problem: QuickProblem, unknowns: Array, unit: float, spread: SpreadParts) -> QuickFit:
    """Fit a window beside the unknowns (u,) of another one.

    Parameters
    ----------
    problem : QuickProblem
    unknowns : (u,) array
    unit : float
        Total gap at the motor (rad) per half gap at the load.
    spread : SpreadParts

    Raises
    ------
    InvalidInput
        The unknowns are not those of the problem's model.
    """
    if unknowns.size != (count := len(problem.model.unknowns)):
        raise InvalidInput(f"fitted beside {unknowns.size} unknowns, and the model has {count}")
    free, first = _of_each_window(problem), [each.first for each in problem.model.unknowns]
    found = _in_own_noise(problem, _best(problem, problem.beside(unknowns))[0], free, _STEPS)
    # The load's first motion counts last: under friction, or in wrong noise, it goes astray.
    for _ in range(_PASSES):
        found = _further(found, problem.free & (free | first), _STEPS)
    return _answer(found, unit, spread)


def unknowns_in(problem: QuickProblem, half: float) -> Array:
    """Unknowns (u,) of a window with a half gap (m or rad at the load)."""
    starts = _best(problem, problem.places(half))[:_KEPT]
    found = [_in_own_noise(problem, start, problem.free, _MANY_STEPS).best for start in starts]
    return min(found, key=lambda fit: float(np.sum(fit.raw**2))).values


def _best(problem: QuickProblem, tried: list[Array]) -> list[Array]:
    """Starts (u,), those that leave least first."""
    costs = [float(np.sum(problem.misfit(values, problem.model.speed) ** 2)) for values in tried]
    return [tried[place] for place in np.argsort(costs, kind="stable")]


def _of_each_window(problem: QuickProblem) -> Flags:
    """(u,) unknowns that each window has of its own, but the load's first motion where an observer sees that."""
    still = problem.model.speed == 0.0
    unknowns = problem.model.unknowns
    return problem.free & [each.unit == "load" and (still or not each.first) for each in unknowns]


def _in_own_noise(problem: QuickProblem, start: Array, free: Flags, steps: int) -> Search:
    """Descend from a start, at first in white noise, then in what that leaves."""
    speed = problem.model.speed
    rough = float(np.sqrt(np.mean(problem.misfit(start, speed) ** 2)))
    white = Autoregression.white(max(_QUIETER * rough, 1e-9 * problem.range))
    fit = descend(problem, start, white, free, steps, speed)
    return _further(Search(problem, white, fit, (), free), free, steps)


def _further(found: Search, free: Flags, steps: int) -> Search:
    """Descend from the best fit, under a slow observer, in the noise that it leaves."""
    problem, noise = found.problem, noise_in(found.problem, found.best)
    slowly = problem.model.slowing[1] * problem.model.speed
    return Search(problem, noise, descend(problem, found.best.values, noise, free, steps, slowly), (), free)


def _answer(found: Search, unit: float, spread: SpreadParts) -> QuickFit:
    fit, count = found.best, found.problem.count
    half, own = abs(float(fit.values[HALF])), math.hypot(fit.std(HALF, found.free), rounded(found))
    least = math.hypot(spread.share * half, spread.counts * count)
    std = math.hypot(spread.noise * own, least)
    still = abs(_step(fit, found.free)) <= _LAST_STEP * std
    misfit = max(float(np.sqrt(np.mean(fit.raw**2))), _ROUNDED * count)
    return QuickFit(unit * half, unit * std, misfit, still, unit * least)


def _step(fit: Fit, free: Flags) -> float:
    """Change of the half gap in one more step, m or rad at the load."""
    size = np.linalg.norm(fit.rows, axis=1)
    use = np.flatnonzero(free & (size > 0.0))
    if HALF not in use:
        return 0.0
    step = np.linalg.lstsq((fit.rows[use] / size[use, None]).T, -fit.residual, rcond=1e-12)[0] / size[use]
    return float(step[int(np.flatnonzero(use == HALF)[0])])
