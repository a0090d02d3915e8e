"""Fit of a window to a machine whose own numbers are known roughly, or from earlier windows.

The fit of gap and place in the window's own noise (`fit`) and that of the model's factors (`free_model`) take turns:
the noise is estimated from the residual of the adapted model, and the factors in this noise. Where the factors are
known well, one turn is enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.estimate import MachineReading
from servotwin.estimation.whitened.fit import AlignedFit, align_and_fit, look_around
from servotwin.estimation.whitened.free_model import (
    BELIEVED,
    FACTORS,
    LARGEST,
    FactorPrior,
    FreeFit,
    FreeProblem,
    adapted,
)
from servotwin.estimation.whitened.reduction import Point
from servotwin.estimation.whitened.settings import WhitenedSettings
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_TURNS = 5
_STILL = 0.1  # standard deviations of a factor: a smaller move needs no other turn
_WIDE = (0.01, 0.05, 0.005, 0.02)  # relative spreads of the factors: wider ones are searched before the noise is known
_AT_END = 1e-3  # of the range of a factor
_VAGUE = 1e-5  # of the position's variation: white noise that small leaves all to the window, nothing to the prior


@dataclass(frozen=True, eq=False)
class LearntFit:
    """A window's fit with the machine that it shows.

    Attributes
    ----------
    servo : Servo
        Adapted to the window.
    aligned : AlignedFit
        With this servo's response.
    free : FreeFit
        In the same noise, with the factors' prior.
    problem : FreeProblem
        Of which `free` is the minimum.
    """

    servo: Servo
    aligned: AlignedFit
    free: FreeFit
    problem: FreeProblem

    @property
    def beyond(self) -> str:
        """Sentence on a factor that lies at the end of what is allowed; empty where none does."""
        low, high = self.problem.prior.limits()
        ends = _AT_END * (high - low)
        for name, factor, least, most in zip(FACTORS, self.free.factors, low + ends, high - ends, strict=True):
            if not least < factor < most:
                off = 100.0 * math.expm1(factor)
                return (
                    f"{name} would have to be {off:+.3g} % off the model, {LARGEST:g} spreads from what is known of it"
                )
        return ""

    def gap_std(self, calibration: float) -> float:
        """Standard deviation of the gap with the factors free, rad."""
        return calibration * math.sqrt(self.free.covariance[0, 0] * max(1.0, self.aligned.whitened.variance))

    def reading(self, calibration: float) -> MachineReading:
        """Factors after this window, what was known of them before included."""
        return _reading(self.free.factors, self._scale(calibration) * self.free.covariance[2:, 2:])

    def reading_of_either(self, single: Point, calibration: float) -> MachineReading | None:
        """Factors after a window that a `single` contact explains as well as two.

        Both fits count alike, and what they differ by is part of the spread. None: the factors are known well already,
        or with what is known of them one contact does not explain the window.
        """
        low, high = self.problem.prior.limits()
        if not np.any(high - low > 2.0 * LARGEST * np.array(_WIDE)) or self.beyond:
            return None
        one = self.problem.descend(np.array([self.problem.largest, single.place, *self.free.factors]), (False, True))
        if one.cost > self.free.cost + BELIEVED * max(1.0, self.aligned.whitened.variance):
            return None
        away = one.factors - self.free.factors
        spread = 0.5 * self._scale(calibration) * (self.free.factor_covariance + one.factor_covariance)
        return _reading(self.free.factors + 0.5 * away, spread + 0.25 * np.outer(away, away))

    def _scale(self, calibration: float) -> float:
        """Factor on covariances for a residual of variance 1."""
        return calibration**2 * max(1.0, self.aligned.whitened.variance)


def _reading(factors: Array, covariance: Array) -> MachineReading:
    return MachineReading(tuple(factors.tolist()), tuple(covariance.ravel().tolist()))


def learn_and_fit(
    theta_m: Array,
    position: Array,
    rate: float,
    servo: Servo,
    prior: float,
    settings: WhitenedSettings,
    machine: FactorPrior,
) -> LearntFit:
    """Fit theta_m (n,) rad and position (n,) m sampled at `rate` (Hz) with the factors free within what is known.

    `prior` (rad) is one of the gaps from which the search begins; `machine` is what is known of the factors on `servo`.
    """
    factors = machine.mean
    slow, points = look_around(theta_m, position, rate, adapted(servo, factors), prior, settings)
    spread = np.sqrt(np.diag(machine.covariance))
    if np.any(spread > _WIDE):
        noise = Autoregression.white(_VAGUE * float(np.std(slow.position)))
        largest = 2.0 * float(np.ptp(slow.theta_m))
        problem = FreeProblem(slow, noise, servo, machine, largest)
        fits = [problem.descend(np.array([*point, *factors]), (True, True)) for point in points]
        fits.sort(key=lambda one: one.cost)
        factors, points = fits[0].factors, [one.point for one in fits[:2]]
    for _ in range(_TURNS):
        here = adapted(servo, factors)
        aligned = align_and_fit(theta_m, position, rate, here, points, settings)
        whitened = aligned.whitened
        problem = FreeProblem(whitened.reduction, whitened.noise, servo, machine, aligned.largest)
        free = problem.descend(np.array([*whitened.point, *factors]), (True, True))
        still = np.abs(free.factors - factors) <= _STILL * np.sqrt(np.diag(free.covariance)[2:])
        if np.all(still):
            break
        factors, points = free.factors, [free.point]
    return LearntFit(here, aligned, free, problem)
