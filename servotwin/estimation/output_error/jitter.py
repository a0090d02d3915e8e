"""Errors of the position that grow with the speed, as where the times of the samples jitter.

The noise of a fit is one and the same all over a window. Where the times jitter, a load at rest shows none of it, and a
moving one much: the samples in motion count too much, and the gap seems better known than it is. Quick errors of the
model do the same, but they last for more than a sample.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.models import HALF
from servotwin.estimation.output_error.problem import Problem
from servotwin.estimation.output_error.rounding import on_samples
from servotwin.plant.signals import Array

# A sample less the mean of its neighbours: variance that white noise gives it, and sum of the squared correlations of
# these differences, whose squares are the data of the test.
_GAIN, _DEPENDENT = 1.5, 1.0 + 2.0 * ((2.0 / 3.0) ** 2 + (1.0 / 6.0) ** 2)
_NEXT = -2.0 / 3.0  # correlation of neighbouring differences of white noise; that of lasting errors is positive
_SURE = 10.83  # of chi-square with one degree of freedom: in 2000 windows without jitter one is beyond it, uphill
_COUNTS = 1.0  # in the fastest motion: rounding makes less


class TimeJitter(NamedTuple):
    """Errors that grow with the speed.

    Attributes
    ----------
    time : float
        Standard deviation of the times that would make them, s; 0: none show.
    half : float
        Standard deviation of the half gap by them, m or rad at the load.
    lasting : bool
        They last for more than a sample, so that no noise makes them.
    """

    time: float = 0.0
    half: float = 0.0
    lasting: bool = False


def time_jitter(found: Search, which: int = HALF) -> TimeJitter:
    """Errors that grow with the speed in a fit's residual; `which`: unknown that counts in place of the half gap.

    The squares of its differences are regressed on the squared speed (Breusch and Pagan's test, studentised by
    Koenker): the slope is the variance of the times. What it does to the half gap is linearised; and no number is known
    better than the mean of the samples in motion, each with the weight of its noise.
    """
    problem, raw = found.problem, found.best.raw
    if not isinstance(problem, Problem) or problem.model.speed == 0.0:
        return TimeJitter()
    speed, differences = _speed(found, problem), raw[1:-1] - 0.5 * (raw[2:] + raw[:-2])
    test, variance = _regressed(differences**2 / _GAIN, speed[1:-1] ** 2)
    time = math.sqrt(max(0.0, variance))
    if test <= _SURE * _DEPENDENT or time * float(np.max(np.abs(speed))) <= _COUNTS * problem.count:
        return TimeJitter()
    noise = time * speed
    least = float(np.sum(noise**4)) / float(np.linalg.norm(noise)) ** 3
    half = max(least, float(np.linalg.norm(_weights(found, which) * noise)))
    return TimeJitter(time, half, _lasting(speed[1:-1] * differences))


def _lasting(differences: Array) -> bool:
    """Tell errors that last from noise, by the correlation of neighbouring differences."""
    return float(differences[1:] @ differences[:-1]) > 0.5 * _NEXT * float(differences @ differences)


def _speed(found: Search, problem: Problem) -> Array:
    """(m,) speed of the load in the fit."""
    slowly, size = problem.model.slowing[-1] * problem.model.speed, found.best.raw.size
    margin = (problem.position.size - size) // 2
    return problem.motion(found.best.values, slowly).velocity[margin : margin + size]


def _regressed(squares: Array, by: Array) -> tuple[float, float]:
    """Samples times the explained share of a regression on one column and a constant, and its slope; 0 if downhill."""
    rest, column = squares - squares.mean(), by - by.mean()
    size, total = float(column @ column), float(rest @ rest)
    if size == 0.0 or total == 0.0:
        return 0.0, 0.0
    slope = float(column @ rest) / size
    return (squares.size * slope**2 * size / total, slope) if slope > 0.0 else (0.0, 0.0)


def _weights(found: Search, which: int) -> Array:
    """(m,) change of an unknown by each sample of the residual, linearised, beside the other unknowns."""
    rows = found.best.rows[found.free]
    at, size = int(np.sum(found.free[:which])), np.linalg.norm(rows, axis=1)
    size[size == 0.0] = 1.0
    scaled = rows / size[:, None]
    inverse = np.linalg.pinv(scaled @ scaled.T, rcond=1e-10, hermitian=True)
    white = inverse[at] @ scaled[:, : found.best.raw.size] / size[at]
    return on_samples(found, white[None])[0]
