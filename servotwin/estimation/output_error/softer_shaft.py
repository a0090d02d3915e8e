"""Shaft that is much softer than the stated one: friction winds it up, and that looks like a gap.

Where contacts are gentle or few, a window does not tell the stiffness, and what it says of the gap rests on the stated
one. Walls 10 to 100 times softer than stated made lower bounds above the true gap, and gaps of three times the true
one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from servotwin.estimation.output_error.fit import Fit, Search, descend, plain_cost
from servotwin.estimation.output_error.learnt_shaft import adapted_shaft
from servotwin.estimation.output_error.models import HALF, LEARNT, OFFSET, Flags, ShaftModel
from servotwin.estimation.output_error.problem import LARGEST, Problem

_STIFFNESS, _DAMPING = "shaft stiffness", "shaft damping"
_SOFTER = math.log(10.0)  # logarithm of how much softer; it may be off by as much, which is as stated or 100 times
_BEGIN = (0.0, -0.75, 0.75)  # of that
_STEPS = 20
_TOLD = 0.75  # of what is usually known of the stiffness: less is left by a window that tells of it
_BOUNDED = (0.9, 0.0)  # of a half gap that is excluded with the stated shaft
_ACCEPTED = (0.9, 0.6, 0.3)  # of one that would be accepted, to begin with
# Fall of the cost, over the noise's variance: 92 to 154 of five simulated walls 11 to 22 times softer than stated, at
# most 36 of seven as stated.
_BETTER = 60.0


def softer_explains(found: Search, half: float, like: list[Fit], limit: float) -> bool:
    """True where a softer shaft explains a window at a gap that is excluded with the stated one.

    Parameters
    ----------
    found : Search
    half : float
        Half gap (m or rad at the load) below which every one is excluded.
    like : list of Fit
        Those whose flanks a fit may have.
    limit : float
        Cost of a fit that explains the window.
    """
    soft, free = _softened(found), found.free.copy()
    if soft is None:
        return False
    free[HALF] = False
    return any(fit.cost <= limit for fit in _fits(found, soft, half, like, _BOUNDED, free))


def softer_is_better(found: Search) -> str:
    """Sentence for a gap of which a shaft much softer than the stated one makes another and a likelier one; or empty.

    It is asked for where the window does not tell the stiffness: elsewhere the fit has found it.
    """
    best, soft = found.best, _softened(found)
    if soft is None or best.std(_place(found), found.free) < _TOLD * _stated(found):
        return ""
    fits = _fits(found, soft, float(best.values[HALF]), [best], _ACCEPTED, found.free)
    softest = min(fits, key=lambda fit: fit.cost)
    if best.cost - softest.cost < _BETTER * best.variance():
        return ""
    times = math.exp(_SOFTER - float(softest.values[_place(found)]))
    return f"a shaft {times:.2g} times softer than the stated one explains the window better, with another gap"


def _softened(found: Search) -> Search | None:
    """The search with a softer shaft whose stiffness is hardly known; None where windows told of it, or there is
    none."""
    problem = found.problem
    if not isinstance(problem, Problem) or not isinstance(problem.model, ShaftModel):
        return None
    model, changes = problem.model, np.zeros(4)
    if model.unknowns[_place(found)].std < _TOLD * _stated(found):
        return None
    changes[[LEARNT[_STIFFNESS], LEARNT[_DAMPING]]] = -_SOFTER, -0.5 * _SOFTER  # its damping ratio stays
    priors = model.priors._replace(stiffness=_SOFTER / LARGEST)
    soft = replace(model, axis=adapted_shaft(model.axis, changes), priors=priors, learnt=None)
    return replace(found, problem=replace(problem, model=soft))


def _fits(
    found: Search, soft: Search, half: float, like: list[Fit], shares: tuple[float, ...], free: Flags
) -> Iterator[Fit]:
    """Fits with a softer shaft, each from a share of a half gap with a flank of fits that are like it."""
    place, rate = _place(found), found.problem.model.slowing[-1] * found.problem.model.speed
    for share in shares:
        starts = []
        for fit in like:
            for side in (-1.0, 1.0):
                values = fit.values.copy()
                values[OFFSET] += side * (share * half - values[HALF])
                values[HALF] = share * half
                starts += [np.where(np.arange(values.size) == place, begin * _SOFTER, values) for begin in _BEGIN]
        begin = min(starts, key=lambda values: plain_cost(soft.problem, values, rate))
        yield descend(soft.problem, begin, found.noise, free, _STEPS, rate)


def _place(found: Search) -> int:
    """Of the stiffness among the unknowns."""
    return [unknown.name for unknown in found.problem.model.unknowns].index(_STIFFNESS)


def _stated(found: Search) -> float:
    """Standard deviation of the stiffness's logarithm without any window."""
    assert isinstance(found.problem.model, ShaftModel)
    return found.problem.model.priors.stiffness
