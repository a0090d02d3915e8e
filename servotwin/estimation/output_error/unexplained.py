"""Error of a half gap by motion that the model leaves: friction of another kind, a shaft that is soft at first contact,
a sensor that errs with each turn.

Such errors are alike in every contact. Neither noise that is learnt from the residual nor a comparison of the window's
halves shows what they do to the gap: of accepted gaps some were a fifth off, and 0.1 % wide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.output_error.fit import Fit, Search, whitened_rows
from servotwin.estimation.output_error.models import HALF
from servotwin.plant.signals import Array

_CHANCE = 2.0  # times the usual variance of an average of white noise
_AVERAGED = 0.5  # radians of the shaft's own frequency
_EVENLY = 1.0 / math.sqrt(12.0)  # standard deviation of a place anywhere in an interval, of its length


def slow(raw: Array, size: int) -> float:
    """rms of a residual (m,) averaged over so many samples, beyond what white noise would leave."""
    left = float(np.mean(np.convolve(raw, np.full(size, 1.0 / size), "valid") ** 2))
    return math.sqrt(max(0.0, left - _CHANCE * 0.5 * float(np.mean(np.diff(raw) ** 2)) / size))


def slow_error(found: Search) -> float:
    """rms (m or rad at the load) of slow motion that neither model nor noise explains.

    0 where rounding and white noise explain it, and of a motion without dynamics, whose misfits are judged otherwise.
    """
    problem, raw = found.problem, found.best.raw
    if problem.model.speed == 0.0:
        return 0.0
    averaged = round(_AVERAGED / (problem.model.speed * problem.interval))
    left = slow(raw, max(1, min(averaged, raw.size // 100)))
    return math.sqrt(max(0.0, left**2 - (_EVENLY * problem.count) ** 2))


def unexplained(found: Search, which: int = HALF) -> float:
    """Standard deviation of the half gap, or of another unknown (m or rad at the load), by the slow error: it may hide
    as much as it leaves.
    """
    error = slow_error(found)
    return max(error, *left_open(found, error, [which])) if error > 0.0 else 0.0


def left_open(found: Search, error: float, places: Sequence[int]) -> list[float]:
    """Standard deviations of unknowns at places (f,), beside the other ones, if an error's rms is one normal error.

    It is alike in every contact, so that it counts once, whatever the samples.
    """
    best, problem = found.best, found.problem
    noise = Autoregression.white(error * math.sqrt(best.raw.size))
    rate = problem.model.slowing[-1] * problem.model.speed
    residual, rows, raw = whitened_rows(problem, best.values, noise, found.free, rate)
    single = Fit(best.values, residual, rows, 0.0, raw, 0)
    return [single.std(place, found.free) for place in places]
