"""Fit of a window to a machine whose own numbers are known roughly, or from earlier windows.

The fit of gap and place in the window's own noise (`fit`) and that of the model's factors (`free_model`) take turns:
the noise is estimated from the residual of the adapted model, and the factors in this noise. Where the factors are
known well, one turn is enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.least_squares import least_squares
from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.estimate import MachineReading
from servotwin.estimation.whitened.doubt import gap_doubt
from servotwin.estimation.whitened.fit import AlignedFit, align_and_fit, coarse_search
from servotwin.estimation.whitened.free_model import (
    BELIEVED,
    COMPLIANCE,
    FACTORS,
    FREEDOM,
    LARGEST,
    FactorPrior,
    FreeFit,
    FreeProblem,
    adapted,
    other_screws,
)
from servotwin.estimation.whitened.reduction import Point
from servotwin.estimation.whitened.settings import WhitenedSettings
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_TURNS = 5
_STILL = 0.1  # standard deviations of a factor: a smaller move needs no other turn
_TOGETHER = 5.0  # spreads: as unlikely for four factors as LARGEST is for one
_GAP_ROW, _PLACE_ROW = 0, 1  # of the derivatives
_AT_END = 1e-3  # of the range of a factor
_SHOWN = 1.0  # information on the softness beyond what is usual of it: below, the window says nothing
_MOST_KNOWN = 1e7  # of the softness: no number of windows tells it better than to 0.0003
_VAGUE = 1e-5  # of the position's variation: white noise that small leaves all to the window, nothing to the prior


class WindowSoftness(NamedTuple):
    """The screw's softness as one window shows it, and what it does to the gap that is fitted with the model's screw.

    Attributes
    ----------
    value, information : float
        The structure's stiffness over the screw's beyond the model's, and one over its variance in noise of variance 1.
    slope : float
        Change of the gap (rad), or of the place, per softness, the model's factors moving along.
    """

    value: float
    information: float
    slope: float

    def joined(self, known: tuple[float, float], scale: float) -> tuple[float, float]:
        """Softness and information with those `known` before; `scale`: variance of the residual."""
        value, before = known
        own = self.information / scale
        total = before + own
        return ((before * value + own * self.value) / total, min(total, _MOST_KNOWN)) if total > 0.0 else known

    def moved(self, known: tuple[float, float], scale: float) -> float:
        """Root mean square (rad) of what the softness does to the gap, as far as all windows know it."""
        value, information = self.joined(known, scale)
        return abs(self.slope) * math.hypot(value, 1.0 / math.sqrt(information + 1.0 / COMPLIANCE**2))


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
        """Sentence on factors that lie at the end of what is allowed, or beyond it together; empty where none do."""
        low, high = self.problem.prior.limits()
        ends = _AT_END * (high - low)
        for name, factor, least, most in zip(FACTORS, self.free.factors, low + ends, high - ends, strict=True):
            if not least < factor < most:
                off = 100.0 * math.expm1(factor)
                return (
                    f"{name} would have to be {off:+.3g} % off the model, {LARGEST:g} spreads from what is known of it"
                )
        away = self.problem.prior.root @ (self.free.factors - self.problem.prior.mean)
        if float(away @ away) <= _TOGETHER**2:
            return ""
        parts = (f"{name} {100.0 * math.expm1(x):+.3g} %" for name, x in zip(FACTORS, self.free.factors, strict=True))
        return (
            f"the machine would have to be {np.linalg.norm(away):.3g} spreads from what is known of it, and "
            f"{_TOGETHER:g} are allowed: {', '.join(parts)} off the model"
        )

    def gap_std(self, calibration: float) -> float:
        """Standard deviation of the gap with the factors free, rad."""
        return math.sqrt(self.scale(calibration) * self.free.covariance[0, 0])

    def doubt(self, ramp: float, calibration: float) -> float:
        """Root mean square (rad) of what machines and sensors that are not as assumed can do to the gap.

        A screw that is soft for certain moves the gap whatever the factors have taken up of it. `ramp`: rad/s.
        """
        variance = max(1.0, self.aligned.whitened.variance)
        at = np.array([*self.free.point, *self.free.factors])
        moved = self._softness.moved(self.problem.prior.softness, self.scale(calibration))
        others = gap_doubt(self.problem, at, variance, self.aligned.delay, ramp, learnt=True)
        return math.hypot(others, moved, self._moved_by_screw(at, (True, True)).gap)

    def _moved_by_screw(self, at: Array, free: tuple[bool, bool]) -> Point:
        """Root mean square of what an elastic screw that is not quite the model's does to gap (rad) and place.

        A stiffer and a softer screw count as far as the window makes them likely beside the model's. What many windows
        told does not: the factors took up there what the screw was off by.
        """
        prior = self.problem.prior
        if self.problem.servo.rigid:
            return Point(0.0, 0.0)
        problem = replace(self.problem, prior=prior if prior.wide else FactorPrior.of_spreads(*FREEDOM))
        fits = [problem.descend(at, free), *other_screws(problem, at, free)]
        worse = np.array([fit.cost for fit in fits]) - min(fit.cost for fit in fits)
        likely = np.exp(-0.5 * worse / max(1.0, self.aligned.whitened.variance))
        moved = np.array([fit.point for fit in fits]) - np.array(fits[0].point)
        return Point(*np.sqrt(likely @ np.square(moved) / likely.sum()).tolist())

    def reading(self, calibration: float) -> MachineReading:
        """Factors after this window, what was known of them before included."""
        scale = self.scale(calibration)
        softness = self._softness.joined(self.problem.prior.softness, scale)
        return _reading(self.free.factors, self.free.learnt(self.problem.prior, scale), softness)

    @cached_property
    def _softness(self) -> WindowSoftness:
        """The screw's softness as this window alone shows it."""
        return self._softness_at(np.array([*self.free.point, *self.free.factors]), _GAP_ROW)

    def way_moved(self, at: Array, calibration: float) -> float:
        """Root mean square (rad) of what the softness does to the motor's way to the only contact of a window.

        `at` (6,) is a point in so wide a gap that the window has no other contact.
        """
        soft, scale = self._softness_at(at, _PLACE_ROW), self.scale(calibration)
        moved = math.hypot(
            soft.moved(self.problem.prior.softness, scale), self._moved_by_screw(at, (False, True)).place
        )
        return 0.5 * float(at[0]) * moved

    def _softness_at(self, at: Array, first: int) -> WindowSoftness:
        """The screw's softness as this window alone shows it, and its effect on gap or place (`first` row).

        With what earlier windows told of the factors it would show none: on a rigid screw, these took it up.
        """
        usual = FactorPrior.of_spreads(*FREEDOM)
        problem = replace(self.problem, prior=usual, compliance=COMPLIANCE)
        residual, rows = problem.rows(at, keep=True)
        solved = least_squares(rows[first:], residual)
        covariance = solved.root.T @ solved.root
        variance = float(covariance[-1, -1])
        # Without what is usual of it, which is part of the solution and must not count with every window.
        information = max(0.0, 1.0 / variance - 1.0)
        shown = float(solved.coefficients[-1]) / variance
        value = COMPLIANCE * shown / information if information > _SHOWN else 0.0
        return WindowSoftness(
            value,
            information / COMPLIANCE**2 if information > _SHOWN else 0.0,
            float(covariance[0, -1]) / variance / COMPLIANCE,
        )

    def reading_of_either(self, single: Point, calibration: float) -> MachineReading | None:
        """Factors after a window that a `single` contact explains as well as two.

        Both fits count alike, and what they differ by is part of the spread. None: the factors are known well already,
        or with what is known of them one contact does not explain the window.
        """
        if not self.problem.prior.wide or self.beyond:
            return None
        one = self.one_contact(single.place)
        if one is None:
            return None
        away = one.factors - self.free.factors
        prior, scale = self.problem.prior, self.scale(calibration)
        spread = 0.5 * (self.free.learnt(prior, scale) + one.learnt(prior, scale))
        return _reading(self.free.factors + 0.5 * away, spread + 0.25 * np.outer(away, away), prior.softness)

    def one_contact(self, place: float) -> FreeFit | None:
        """Fit of one contact, from a place in the widest gap on; None where two are believed."""
        one = self.problem.descend(np.array([self.problem.largest, place, *self.free.factors]), (False, True))
        return one if one.cost <= self.free.cost + BELIEVED * max(1.0, self.aligned.whitened.variance) else None

    def scale(self, calibration: float) -> float:
        """Factor on covariances for a residual of variance 1."""
        return calibration**2 * max(1.0, self.aligned.whitened.variance)


def _reading(factors: Array, covariance: Array, softness: tuple[float, float]) -> MachineReading:
    return MachineReading(tuple(factors.tolist()), tuple(covariance.ravel().tolist()), softness)


def as_known(aligned: AlignedFit, servo: Servo, machine: FactorPrior) -> LearntFit:
    """Take a fit with the factors that are known on a servo for one in which they were free."""
    whitened = aligned.whitened
    problem = FreeProblem(whitened.reduction, whitened.noise, servo, machine, aligned.largest)
    here = problem.descend(np.array([*whitened.point, *machine.mean]), (True, True), evaluations=1)
    return LearntFit(adapted(servo, machine.mean), aligned, here, problem)


def learn_and_fit(
    theta_m: Array,
    position: Array,
    rate: float,
    servo: Servo,
    prior: float,
    settings: WhitenedSettings,
    machine: FactorPrior,
    first: AlignedFit | None = None,
) -> LearntFit:
    """Fit theta_m (n,) rad and position (n,) m sampled at `rate` (Hz) with the factors free within what is known.

    `prior` (rad) is one of the gaps from which the search begins; `machine` is what is known of the factors on `servo`.
    `first`: fit of the same with the factors that are known, where it was made.
    """
    if first is not None:
        return _take_turns(theta_m, position, rate, servo, settings, machine, machine.mean, first)
    factors = machine.mean
    slow, points = coarse_search(theta_m, position, rate, adapted(servo, factors), prior, settings)
    if machine.wide:  # what is known roughly is searched before the noise is known
        noise = Autoregression.white(_VAGUE * float(np.std(slow.position)))
        largest = 2.0 * float(np.ptp(slow.theta_m))
        problem = FreeProblem(slow, noise, servo, machine, largest)
        fits = [problem.descend(np.array([*point, *factors]), (True, True)) for point in points]
        fits.sort(key=lambda one: one.cost)
        factors, points = fits[0].factors, [one.point for one in fits[:2]]
    first = align_and_fit(theta_m, position, rate, adapted(servo, factors), points, settings)
    return _take_turns(theta_m, position, rate, servo, settings, machine, factors, first)


def _take_turns(
    theta_m: Array,
    position: Array,
    rate: float,
    servo: Servo,
    settings: WhitenedSettings,
    machine: FactorPrior,
    factors: Array,
    aligned: AlignedFit,
) -> LearntFit:
    """Fit factors, and gap and place, in turns; `aligned` is the fit with `factors`."""
    for left in reversed(range(_TURNS)):
        whitened = aligned.whitened
        problem = FreeProblem(whitened.reduction, whitened.noise, servo, machine, aligned.largest)
        free = problem.descend(np.array([*whitened.point, *factors]), (True, True))
        still = np.abs(free.factors - factors) <= _STILL * np.sqrt(np.diag(free.covariance)[2:])
        if np.all(still) or left == 0:
            break
        factors = free.factors
        here = adapted(servo, factors)
        aligned = align_and_fit(theta_m, position, rate, here, [free.point], settings, aligned)
    return LearntFit(adapted(servo, factors), aligned, free, problem)
