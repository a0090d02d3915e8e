"""The flank that the motor touches in a window in which it touches one only.

Such a window does not show the gap, but it tells the place of that flank: of the driven end, unloaded, for an angle of
the motor. Stiffness, friction, ratio and delay are free within what is known of them, so that their doubt is in its
standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.output_error.fit import Fit, FitProblem, Search, descend, noise_in, on_each_flank
from servotwin.estimation.output_error.flank_models import Flank, FlankModel, OwnModel, by_flank
from servotwin.estimation.output_error.jitter import time_jitter
from servotwin.estimation.output_error.mismatches import (
    APART,
    DOUBT,
    UNEXPLAINED,
    between_halves,
    unusual_numbers,
)
from servotwin.estimation.output_error.models import HALF, OFFSET, RATIO, ShaftModel, other_friction
from servotwin.estimation.output_error.problem import Problem
from servotwin.estimation.output_error.rounding import rounded
from servotwin.estimation.output_error.settings import OutputErrorSettings
from servotwin.estimation.output_error.soft_contact import moved_by_contact
from servotwin.estimation.output_error.unexplained import slow, unexplained
from servotwin.estimation.output_error.verdict import BELIEVED, RIVAL
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array

_STEPS = 15
_ROUNDED = 0.5  # of a count: error of a flank's place that does not average out
_LEAST = 0.02  # of the window: contact that tells a flank
_LEAST_FRICTION = 0.02  # half-width of the stated friction
_WOUND_UP = 2.0  # times the stated friction: what may wind up the shaft against the other flank


class FlankPlace(NamedTuple):
    """Place of a flank.

    Attributes
    ----------
    at : float
        Motor at the load, m or rad.
    place, std : float
        Of the driven end, unloaded on the flank, m or rad at the load.
    lead : float
        Way of the motor off the flank in the window at least: the gap was no narrower.
    search : Search
        The fit with this place as its second unknown.
    """

    at: float
    place: float
    std: float
    lead: float
    search: Search


@dataclass(frozen=True, eq=False)
class OneFlank:
    """A window in which the motor touches one flank for certain.

    Attributes
    ----------
    found : Search
    single : Fit
        The best one with one flank.
    likely : tuple of Fit
        Others that explain the window nearly as well.
    side : float
        As of `Flank`.
    settings : OutputErrorSettings
    """

    found: Search
    single: Fit
    likely: tuple[Fit, ...]
    side: float
    settings: OutputErrorSettings

    @classmethod
    def of(cls, found: Search, settings: OutputErrorSettings) -> OneFlank | None:
        """Read the flank from the fit of a window that one flank explains; None where it is not told for certain."""
        model, problem = found.problem.model, found.problem
        # One mass on a rigid screw creeps to its target alike with another ratio and with another delay.
        if not isinstance(model, OwnModel) or not isinstance(problem, Problem):
            return None
        if isinstance(model, ShaftModel) and not model.axis.load.free:
            return None
        known = max(_LEAST_FRICTION, settings.friction) / NORMAL_95
        found = _in(replace(problem, model=replace(model, friction=known)), found)
        flanks = [fit for fits in on_each_flank(found) for fit in fits]
        single = min(flanks, key=lambda fit: fit.cost)
        side, variance = _side(found.problem, single), single.variance()
        # A fit may end on the flank opposite to the one on which it began.
        others = (fit.cost for fit in flanks if _side(found.problem, fit) != side)
        if not min(others, default=math.inf) - single.cost >= BELIEVED * variance:
            return None
        fits = (found.best, *found.others, *flanks)
        likely = tuple(fit for fit in fits if fit is not single and fit.cost - single.cost < RIVAL * variance)
        made = cls(found, single, likely, side, settings)
        return made if made._is_sure() else None

    @property
    def axis(self) -> Axis:
        """The axis with the numbers that are known best."""
        return self._model.axis

    @property
    def _model(self) -> OwnModel:
        model = self.found.problem.model
        assert isinstance(model, OwnModel)
        return model

    @property
    def problem(self) -> Problem:
        """The window."""
        assert isinstance(self.found.problem, Problem)
        return self.found.problem

    @property
    def _rate(self) -> float:
        """Of the observer of the last fits, 1/s."""
        return self.problem.model.slowing[-1] * self.problem.model.speed

    @cached_property
    def _touching(self) -> NDArray[np.intp]:
        """(c,) samples in contact."""
        return np.flatnonzero(self.problem.motion(self.single.values, self._rate).sides == self.side)

    @cached_property
    def drive(self) -> Array:
        """(c,) motor at the load, in contact."""
        return np.asarray(self.problem.drive[self._touching])

    @property
    def time(self) -> float:
        """Middle of the samples in contact, s from the first sample of the window."""
        return float(np.mean(self._touching)) * self.problem.interval

    def _is_sure(self) -> bool:
        """Tell whether the window shows contact enough, under numbers that are likely, and the same one throughout."""
        alone = self._search_of(self.single)
        variation = float(np.std(self.problem.position))
        left = slow(self.single.raw, max(1, self.single.raw.size // 100))
        if self._touching.size < _LEAST * self.problem.drive.size or left > UNEXPLAINED * variation:
            return False
        difference, spread = between_halves(alone, OFFSET)
        if unusual_numbers(alone, self.single.values) or abs(difference) > APART * spread:
            return False
        return all(np.any(self.problem.motion(fit.values, self._rate).sides == self.side) for fit in self.likely)

    def _search_of(self, fit: Fit) -> Search:
        free = self.found.free.copy()
        free[HALF] = False
        return replace(self.found, best=fit, others=(), free=free)

    def fitted(self, at: float) -> Search:
        """Fit with the flank's place, with the motor at the load `at`, as its second unknown.

        The noise is learnt anew: what a fit with two flanks bends its numbers to is no noise there.
        """
        known = self._fitted(at, self.found.noise)
        return self._fitted(at, noise_in(known.problem, known.best))

    def _fitted(self, at: float, noise: Autoregression, half: float | None = None) -> Search:
        """As `fitted`, in a noise; `half`: gap that is given, m or rad at the load."""
        model = by_flank(self._model, Flank(self.side, at))
        values, problem = self.single.values.copy(), replace(self.problem, model=model)
        values[OFFSET] += model.flank.less_offset(values)
        if half is not None:
            values[HALF] = half
        alone = self._search_of(self.single)
        fit = descend(problem, values, noise, alone.free, _STEPS, self._rate)
        return replace(alone, problem=problem, best=fit, noise=noise)

    def at(self, at: float) -> FlankPlace:
        """The flank's place, with the motor at the load `at` (m or rad)."""
        found = self.fitted(at)
        place = float(found.best.values[OFFSET])
        std = self.settings.calibration * math.hypot(found.best.std(OFFSET, found.free), rounded(found, OFFSET))
        doubts = (unexplained(found, OFFSET), moved_by_contact(found, OFFSET), time_jitter(found, OFFSET).half)
        floor, others = _ROUNDED * self.problem.count, max(0.0, self._apart(found) - NORMAL_95 * std)
        total = math.hypot(DOUBT * std, *(DOUBT * doubt for doubt in doubts), floor, others, self._friction(found))
        return FlankPlace(at, place, total, self._lead(found, total), found)

    def _apart(self, found: Search) -> float:
        """Largest difference between the flank's place and that of other fits that explain the window."""
        model, fits = found.problem.model, [fit.values for fit in self.likely]
        assert isinstance(model, FlankModel)
        places = [float(values[OFFSET]) + model.flank.less_offset(values) for values in fits]
        # A shaft that is always in contact, with other friction, moves alike.
        without = self._fitted(model.flank.at, found.noise, 0.0).best
        if without.cost - found.best.cost < RIVAL * found.best.variance():
            places.append(float(without.values[OFFSET]))
        return max((abs(place - float(found.best.values[OFFSET])) for place in places), default=0.0)

    def _friction(self, found: Search) -> float:
        """Change of the place by another load friction than the stated one."""
        names = [unknown.name for unknown in found.problem.model.unknowns]
        values = dict(zip(names, found.best.values.tolist(), strict=True))
        return self._softness * other_friction(self.axis, values.get("load friction", 0.0))

    @property
    def _softness(self) -> float:
        """From the motor to the last mass, m/N (rotary: rad per N m)."""
        model = self._model
        if isinstance(model, ShaftModel):
            return 1.0 / self.axis.transmission.k_d + float(np.sum(1.0 / self.axis.load.stiffnesses[1:]))
        return model.moving.flexibility()

    def _lead(self, found: Search, std: float) -> float:
        """Way of the motor off the flank at least, m or rad at the load, less what may wind up the shaft beyond."""
        problem, values = found.problem, found.best.values
        assert isinstance(problem, Problem)
        assert isinstance(problem.model, FlankModel)
        motion = problem.motion(values, self._rate)
        flank = float(values[OFFSET]) + math.exp(float(values[RATIO])) * (
            problem.late_drive(values)[:: problem.parts] - problem.model.flank.at
        )
        load = self.axis.load
        wound_up = _WOUND_UP * self._softness * max(load.friction, load.static or 0.0)
        return max(0.0, float(np.max(self.side * (motion.driven - flank))) - wound_up - NORMAL_95 * std)


def _side(problem: FitProblem, fit: Fit) -> float:
    """The flank that the motor touches in most samples of a fit, as of `Flank`; 0: none."""
    assert isinstance(problem, Problem)
    rate = problem.model.slowing[-1] * problem.model.speed
    return float(np.sign(np.sum(problem.motion(fit.values, rate).sides, dtype=int)))


def _in(problem: Problem, found: Search) -> Search:
    """The fits of a window with another model, or with numbers of it that are known better."""
    rate = problem.model.slowing[-1] * problem.model.speed
    fits = [descend(problem, fit.values, found.noise, found.free, _STEPS, rate) for fit in (found.best, *found.others)]
    best, *others = sorted(fits, key=lambda fit: fit.cost)
    return replace(found, problem=problem, best=best, others=tuple(others))
