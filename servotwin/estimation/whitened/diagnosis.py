"""When the model does not fit: which common fault of the channels would make it fit."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.normal import least_squares
from servotwin.estimation.core.response import response
from servotwin.estimation.whitened.aligned import gaps_to_try
from servotwin.estimation.whitened.reduction import CONSTANT, RESIDUAL, Reduction, factor_for
from servotwin.estimation.whitened.search import search
from servotwin.estimation.whitened.unexplained import slow
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_EXPLAINS, _BETTER = 0.05, 0.2  # share left that counts as a fit; of what the channels as given leave
_POSITION_UNITS = {"mm": 1e-3, "micrometres": 1e-6, "units of 1000 m": 1e3}
_ANGLE_UNITS = {"degrees": math.pi / 180.0, "turns": 2.0 * math.pi, "units of 57.3 rad": 180.0 / math.pi}
_RATES = (0.1, 0.2, 0.5, 2.0, 5.0, 10.0)


def likely_fault(window: Window, theta_m: Array, servo: Servo, unexplained: float) -> tuple[str, ...]:
    """The first fault that, undone, lets the model explain the window; nothing when none does, or none is needed."""
    if unexplained <= _EXPLAINS:
        return ()
    for sentence, angle, position, rate in _candidates(window, theta_m):
        if _share_left(angle, position, rate, servo) < min(_EXPLAINS, _BETTER * unexplained):
            return (sentence,)
    return ()


def _candidates(window: Window, theta_m: Array) -> Iterator[tuple[str, Array, Array, float]]:
    """What may be wrong, and angle, position and rate if that is undone."""
    position, rate = window.position, window.sample_rate
    yield "position and theta_m seem to be swapped", position, theta_m, rate
    yield "position or theta_m seems to have the wrong sign", theta_m, -position, rate
    for unit, factor in _POSITION_UNITS.items():
        yield f"position seems to be in {unit}, not in m", theta_m, factor * position, rate
    for unit, factor in _ANGLE_UNITS.items():
        yield f"theta_m seems to be in {unit}, not in rad", factor * theta_m, position, rate
    for factor in _RATES:
        wrong = f"the sample rate seems to be {factor * rate:.6g} Hz, not {rate:.6g} Hz"
        yield wrong, theta_m, position, factor * rate


def _share_left(theta_m: Array, position: Array, rate: float, servo: Servo) -> float:
    """Slow part of what a plain fit leaves, over that of the position."""
    reduce = decimation(factor_for(response(servo, rate), theta_m.size))
    angle, seen = reduce.rows(np.vstack([theta_m - theta_m[0], position - position[0]]))
    reduction = Reduction.of(angle, seen, response(servo, rate / reduce.factor), skew=False)
    span = float(np.ptp(angle))
    fit = min(search(reduction.coarse(), gaps_to_try(span, 9), span, 1e-4 * span), key=lambda fit: fit.slopes.cost)
    table = reduction.table(fit.point)
    left = table[RESIDUAL] - least_squares(table[CONSTANT:], table[RESIDUAL]).coefficients @ table[CONSTANT:]
    interval = reduction.response.interval * reduction.decimation.factor
    variation = float(np.std(slow(reduction.position, interval)))
    return float(np.sqrt(np.mean(slow(left, interval) ** 2))) / variation if variation > 0.0 else math.inf
