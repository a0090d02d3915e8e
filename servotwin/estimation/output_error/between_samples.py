"""The motor between two samples: a cubic through four of them, whose error moves the load and with it the gap.

A motor that starts within few samples crosses the gap where the cubic is least sure. Six samples show about as much
more of such a motion as they leave open.
"""

from __future__ import annotations

import numpy as np

from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.models import HALF
from servotwin.estimation.output_error.problem import Problem
from servotwin.estimation.output_error.rounding import moved_by
from servotwin.plant.signals import Array

_FOUR, _SIX = (-1.0, 9.0), (3.0, -25.0, 150.0)  # weights of the middle of so many samples, which are symmetric
# The cubic's error there over the fourth difference, and that difference which rounding makes at most (counts).
_CUBIC, _ROUNDED = 3.0 / 128.0, 8.0


def error_between_samples(found: Search, fewest: int) -> Array:
    """Errors (m or rad at the load) of the motor's place between samples; of a load without dynamics they do not count:
    zeros, `fewest` of them."""
    problem = found.problem
    if problem.model.speed == 0.0:
        return np.zeros(fewest)
    return np.asarray(_CUBIC * np.maximum(np.abs(np.diff(problem.drive, 4)) - _ROUNDED * problem.count, 0.0))


def moved_between_samples(found: Search, which: int = HALF) -> float:
    """Change of the half gap (m or rad at the load), linearised, with the motor's places by six samples.

    `which`: unknown that counts in place of the half gap.
    """
    problem = found.problem
    if not isinstance(problem, Problem) or problem.model.speed == 0.0:
        return 0.0
    values, rate = found.best.values, problem.model.slowing[-1] * problem.model.speed
    drive, measured, half_way = problem.late_drive(values), problem.position, 0.5 * problem.interval
    twice = (_with_middles(drive, _middles(drive, _SIX)), _with_middles(measured, _middles(measured, _FOUR)))
    finer = problem.model.position(*twice, half_way, values, rate)[::2]
    change = finer - problem.model.position(drive, measured, problem.interval, values, rate)
    return abs(moved_by(found, change[problem.margin : drive.size - problem.margin], which))


def _middles(values: Array, half_of_weights: tuple[float, ...]) -> Array:
    """(N - 1,) values between samples (N,); beyond the ends they last."""
    weights = np.array([*half_of_weights, *half_of_weights[::-1]])
    wide = np.pad(values, weights.size // 2 - 1, "edge")
    return np.convolve(wide, weights / weights.sum(), "valid")


def _with_middles(values: Array, middles: Array) -> Array:
    """(2 N - 1,) samples and what is between them."""
    out = np.empty(2 * values.size - 1)
    out[::2], out[1::2] = values, middles
    return out
