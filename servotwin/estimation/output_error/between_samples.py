"""The motor between two samples, where its error moves the load and with it the gap."""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.core.motor_angle import noise_of
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.models import DELAY, HALF
from servotwin.estimation.output_error.problem import Problem, delayed
from servotwin.estimation.output_error.refined import PARABOLA, refined
from servotwin.estimation.output_error.rounding import moved_by
from servotwin.plant.signals import Array

# Error of a cubic in the middle over the fourth difference, and that difference which rounding makes at most (counts).
_CUBIC, _ROUNDED = 3.0 / 128.0, 8.0
# Standard deviations of the noise, and share of the motor's range before the load, that may be left open; most lines.
_SHARP, _SMALL, _MOST = 3.0, 1e-4, 8


def error_between_samples(found: Search, fewest: int) -> Array:
    """(N - 4,) errors (m or rad at the load) of the motor's place between samples.

    They do not count, and are `fewest` zeros, where the load has no dynamics.
    """
    problem = found.problem
    if problem.model.speed == 0.0:
        return np.zeros(fewest)
    return np.asarray(_CUBIC * np.maximum(np.abs(np.diff(problem.drive, 4)) - _ROUNDED * problem.count, 0.0))


def parts_needed(drive: Array, position: Array, count: float, lines: int) -> int:
    """Number of parts of an interval at whose ends a model needs the motor's place.

    The arrays (N,) and the count are m or rad at the load; `lines` is the number of straight lines that the model
    itself lays through each part.

    One, unless the motor turns so sharply that a cubic leaves more than its noise open; then as many as make the lines,
    so many in each part, as good as that, up to 8 lines in an interval, rounded up to whole parts.
    """
    allowed = max(count, _SHARP * noise_of(drive), _SMALL * float(np.ptp(drive - position)))
    if float(np.max(np.abs(np.diff(drive, 4)))) * _CUBIC <= allowed:
        return 1
    bent = float(np.max(np.abs(np.diff(drive, 2)))) / 8.0
    needed = math.sqrt(bent / allowed) if allowed > 0.0 else math.inf
    return math.ceil(min(_MOST, needed) / lines)


def moved_between_samples(found: Search, which: int = HALF) -> float:
    """Change of the half gap (m or rad at the load), linearised, with parabolas through the motor's samples in place of
    cubics: about what a motor that turns sharply leaves open; 0 of other motors.

    `which`: unknown that counts in place of the half gap.
    """
    problem = found.problem
    if not isinstance(problem, Problem) or problem.parts == 1:
        return 0.0
    values, rate = found.best.values, problem.model.slowing[-1] * problem.model.speed
    parabolas = refined(problem.drive, problem.parts, PARABOLA)
    drive = delayed(parabolas, float(values[DELAY]) / problem.interval * problem.parts)
    change = problem.less_measured(problem.under(drive, values, rate).position) - problem.misfit(values, rate)
    return abs(moved_by(found, change, which))
