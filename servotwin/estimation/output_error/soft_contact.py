"""Gap that a window would have if its shaft were softer or stiffer at first contact than farther on.

Such a shaft looks like one with another gap: where the first of the way was softer by a tenth of half the gap, gaps
were 7 % off, and what the fit left was less than rounding. But contacts are not equally hard, and the gentle ones tell
the two apart if they are asked.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servotwin.estimation.output_error.fit import Fit, Search
from servotwin.estimation.output_error.models import HALF, ShaftModel
from servotwin.estimation.output_error.problem import Problem
from servotwin.estimation.output_error.rounding import influence
from servotwin.plant.signals import Array

_LENGTH = 0.25  # of the shaft's largest stretch: way on which it becomes as stiff as farther on
_DIFFERENCE = 1e-4  # makes a derivative
_SURE = 4.0  # computed standard deviations of a change by chance: two, each twice the computed one as in `verdict`


def moved_by_contact(found: Search, which: int = HALF) -> float:
    """Change of the half gap (m or rad at the load), linearised, if the stiffness at first contact were free.

    Beyond what noise and rounding make of it. `which`: unknown that counts in place of the half gap.
    """
    problem, whole = found.problem, np.arange(found.best.residual.size)
    if not isinstance(problem, Problem) or not isinstance(problem.model, ShaftModel):
        return 0.0
    (without, *known), (given, *open_) = (
        influence(each, whole, which) for each in (found, _with_soft_contact(found, problem))
    )
    chance = max(0.0, math.hypot(*open_) ** 2 - math.hypot(*known) ** 2)
    return math.sqrt(max(0.0, (given - without) ** 2 - _SURE**2 * chance))


def _with_soft_contact(found: Search, problem: Problem) -> Search:
    """The fit with one more unknown, 0: the softness of its shaft at first contact."""
    best = found.best
    row = found.noise.whiten(_softer(found, problem)[None])[0]
    rows = np.vstack([best.rows, np.pad(row, (0, best.residual.size - row.size))])
    wider = Fit(np.append(best.values, 0.0), best.residual, rows, best.cost, best.raw, best.evaluations)
    return replace(found, best=wider, free=np.append(found.free, True))


def _softer(found: Search, problem: Problem) -> Array:
    """(m,) change of the position if the shaft gave way at first contact.

    A shaft of stiffness k that is stretched by x would pull with k (x - l tanh(x / l)) in place of k x, as if its motor
    were behind by l tanh(x / l).
    """
    values, rate = found.best.values, problem.model.slowing[-1] * problem.model.speed
    drive = problem.late_drive(values)
    motion = problem.under(drive, values, rate)
    stretch = np.where(motion.sides != 0, motion.driven - motion.position, 0.0)
    length = _LENGTH * float(np.max(np.abs(stretch)))
    if length == 0.0:
        return np.zeros(found.best.raw.size)
    later = drive - _DIFFERENCE * length * np.tanh(stretch / length)
    moved = problem.less_measured(problem.under(later, values, rate).position) - problem.less_measured(motion.position)
    return moved / _DIFFERENCE
