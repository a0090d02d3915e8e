"""The flank that the motor touches in a window of a free shaft in which it touches one only.

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

from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.output_error.fit import Fit, Search, descend, on_each_flank
from servotwin.estimation.output_error.jitter import time_jitter
from servotwin.estimation.output_error.mismatches import (
    APART,
    DOUBT,
    UNEXPLAINED,
    between_halves,
    unusual_numbers,
)
from servotwin.estimation.output_error.models import HALF, OFFSET, RATIO, PreparedShaft, ShaftModel, other_friction
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


@dataclass(frozen=True)
class FlankModel(ShaftModel):
    """A free shaft whose second unknown is the place of one flank in place of the offset.

    Attributes
    ----------
    side : float
        1: the flank on which the motor pushes the load forwards; -1: backwards.
    at : float
        Motor at the load (m or rad) for which the place is that of the driven end, unloaded on that flank.
    """

    side: float = 1.0
    at: float = 0.0

    def from_flank(self, values: Array) -> float:
        """Place of the flank less the offset, for unknowns (u,)."""
        return math.exp(float(values[RATIO])) * (self.at - self.side * float(values[HALF]))

    def prepared(self, drive: Array, interval: float, values: Array) -> PreparedShaft:
        """As that of `ShaftModel`."""
        own = values.copy()
        own[OFFSET] -= self.from_flank(values)
        return super().prepared(drive, interval, own)


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
        As of `FlankModel`.
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
        if not isinstance(model, ShaftModel) or not isinstance(problem, Problem) or not model.axis.load.free:
            return None
        known = max(_LEAST_FRICTION, settings.friction) / NORMAL_95
        found = _in(replace(problem, model=replace(model, friction=known)), found)
        flanks = on_each_flank(found)
        lower, upper = (min(fits, key=lambda fit: fit.cost) for fits in flanks)
        side, single, other = (1.0, upper, lower) if upper.cost < lower.cost else (-1.0, lower, upper)
        variance = single.variance()
        if not other.cost - single.cost >= BELIEVED * variance:
            return None
        fits = (found.best, *found.others, *flanks[0], *flanks[1])
        likely = tuple(fit for fit in fits if fit is not single and fit.cost - single.cost < RIVAL * variance)
        made = cls(found, single, likely, side, settings)
        return made if made._is_sure() else None

    @property
    def axis(self) -> Axis:
        """The axis with the numbers that are known best."""
        model = self.found.problem.model
        assert isinstance(model, ShaftModel)
        return model.axis

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

    def fitted(self, at: float, half: float | None = None) -> Search:
        """Fit with the flank's place, with the motor at the load `at`, as its second unknown; `half`: gap that is
        given, m or rad at the load."""
        known = self.problem.model
        assert isinstance(known, ShaftModel)
        model = FlankModel(known.axis, known.priors, known.learnt, known.friction, side=self.side, at=at)
        values, problem = self.single.values.copy(), replace(self.problem, model=model)
        values[OFFSET] += model.from_flank(values)
        if half is not None:
            values[HALF] = half
        alone = self._search_of(self.single)
        fit = descend(problem, values, self.found.noise, alone.free, _STEPS, self._rate)
        return replace(alone, problem=problem, best=fit)

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
        places = [float(values[OFFSET]) + model.from_flank(values) for values in fits]
        # A shaft that is always in contact, with other friction, moves alike.
        without = self.fitted(model.at, 0.0).best
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
        return 1.0 / self.axis.transmission.k_d + float(np.sum(1.0 / self.axis.load.stiffnesses[1:]))

    def _lead(self, found: Search, std: float) -> float:
        """Way of the motor off the flank at least, m or rad at the load, less what may wind up the shaft beyond."""
        problem, values = found.problem, found.best.values
        assert isinstance(problem, Problem)
        assert isinstance(problem.model, FlankModel)
        motion = problem.motion(values, self._rate)
        flank = float(values[OFFSET]) + math.exp(float(values[RATIO])) * (problem.drive - problem.model.at)
        load = self.axis.load
        wound_up = _WOUND_UP * self._softness * max(load.friction, load.static or 0.0)
        return max(0.0, float(np.max(self.side * (motion.driven - flank))) - wound_up - NORMAL_95 * std)


def _in(problem: Problem, found: Search) -> Search:
    """The fits of a window with another model, or with numbers of it that are known better."""
    rate = problem.model.slowing[-1] * problem.model.speed
    fits = [descend(problem, fit.values, found.noise, found.free, _STEPS, rate) for fit in (found.best, *found.others)]
    best, *others = sorted(fits, key=lambda fit: fit.cost)
    return replace(found, problem=problem, best=best, others=tuple(others))
