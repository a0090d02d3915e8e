"""Search for the dynamics of a driven load, and the evidence for other gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.driven_load.problem import ONE_MASS, DrivenLoad, LoadDynamics
from servotwin.estimation.output_error.fit import Fit, descend
from servotwin.estimation.output_error.models import HALF, OFFSET, RATIO
from servotwin.plant.signals import Array

OBSERVER = 0.3
"""Rate of the observer over the load's frequency."""
SLOWER = 0.4
"""Rate of another observer over that one, which must show the same gap."""
_FREQUENCIES = 10
_SWINGS = 0.5  # periods of the slowest load within a mean stroke
_GAPS = (0.8, 0.4, 0.15, 0.05)  # of the lead's range, where the search begins
_FRICTIONS = (0.1, 0.003)  # of the lead's range
_DAMPING = 0.05
_KEPT = 3
_HOPELESS = (5.0, 0.75)  # of the error without dynamics, where the search begins, and after a first descent
_TOO_FAST = 1.2  # of the fastest load that the samples show
_ROUNDS, _GAIN = 4, 0.98  # further descents while they bring the error down to so much
_NEAR = (0.96, 1.04)  # of the gap
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.02)  # of the lost motion: gap
_LEAST_WIND_UP = 0.002  # of the lost motion
_STEPS = (8, 25)


@dataclass(frozen=True, eq=False)
class LoadFit:
    """A fitted load.

    Attributes
    ----------
    problem : DrivenLoad
    fit : Fit
        In white noise of the size of what the fit leaves.
    rate : float
        Of the observer, 1/s.
    """

    problem: DrivenLoad
    fit: Fit
    rate: float

    @property
    def scale(self) -> float:
        """Load per motor, over the problem's ratio."""
        return math.exp(float(self.fit.values[RATIO]))

    @property
    def gap(self) -> float:
        """Total, the load's unit."""
        return 2.0 * self.scale * float(self.fit.values[HALF])

    @property
    def lost(self) -> float:
        """Gap and wind-up together, the load's unit."""
        return self.gap + 2.0 * self.dynamics.friction * self.dynamics.compliance

    @property
    def dynamics(self) -> LoadDynamics:
        return self.problem.dynamics.moved(self.problem.model, self.fit.values)

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.fit.raw**2)))

    def again(self, steps: int, rate: float | None = None) -> LoadFit:
        """Go on from here, with another observer for one."""
        return descended(self.problem, self.fit.values, steps, self.rate if rate is None else rate)

    def split(self, gap: float, steps: int, gap_free: bool) -> LoadFit:
        """Fit with that gap (the load's unit) first, or only; the rest of the lost motion is wind-up to begin with."""
        wind_up = max(0.5 * (self.lost - gap), _LEAST_WIND_UP * self.lost)
        dynamics = self.dynamics
        problem = self.problem.with_load(replace(dynamics, friction=wind_up / dynamics.compliance))
        return descended(problem, carried(self, problem, gap), steps, self.rate, gap_free)


def carried(found: LoadFit, problem: DrivenLoad, gap: float) -> Array:
    """Unknowns (u,) of a problem whose load was set anew: what does not belong to the load is kept."""
    old = found.fit.values
    values = problem.model.start(0.5 * gap / found.scale, float(old[OFFSET]), (0.0, 0.0))
    states = -2 * problem.model.axis.n
    values[OFFSET : RATIO + 1], values[states:] = old[OFFSET : RATIO + 1], old[states:]
    return values


def descended(problem: DrivenLoad, values: Array, steps: int, rate: float, gap_free: bool = True) -> LoadFit:
    """Least squares from unknowns (u,) on, in at most so many steps."""
    left = problem.misfit(values, rate)
    noise = Autoregression.white(max(float(np.sqrt(np.mean(left**2))), 1e-9 * problem.range))
    free = problem.free
    free[HALF] = gap_free
    return LoadFit(problem, descend(problem, values, noise, free, steps, rate), rate)


def slowest_and_fastest(problem: DrivenLoad, strokes: int) -> tuple[float, float]:
    """Natural frequencies between which a recording may show the load's, rad/s."""
    low = 2.0 * math.pi * _SWINGS * max(strokes, 1) / problem.duration
    return low, problem.fastest


def best_fit(
    problem: DrivenLoad, quasi_static: Array, strokes: int, known: LoadDynamics | None = None
) -> LoadFit | None:
    """The load that predicts its motion best, compared with a model (N,) without dynamics; None: none can show.

    The search begins at all frequencies that the recording may show, and at a load that is `known`.
    """
    low, high = slowest_and_fastest(problem, strokes)
    if not high > 2.0 * low:
        return None
    reach, middle = problem.range, -0.5 * float(np.max(problem.lead) + np.min(problem.lead))
    links = ONE_MASS if known is None else known.links
    begins = [
        [LoadDynamics(each, _DAMPING, friction * reach, links=links) for friction in _FRICTIONS]
        for each in np.geomspace(low, high, _FREQUENCIES).tolist()
    ]
    kept = []
    for loads in begins if known is None else [[known], *begins]:
        rate = OBSERVER * loads[0].frequency
        bare = float(np.std(problem.quasi_static_misfit(quasi_static, rate)))
        tried: list[tuple[float, int, DrivenLoad, Array, float]] = []
        for gap in _GAPS:
            for load in loads:
                begun = problem.with_load(load)
                values = begun.start(0.5 * gap * reach, middle)
                tried.append((float(np.std(begun.misfit(values, rate))) / bare, len(tried), begun, values, rate))
        kept.append(min(tried, key=lambda each: each[:2]))
    kept.sort(key=lambda each: each[:2])
    if kept[0][0] > _HOPELESS[0]:
        _, _, begun, values, rate = kept[0]
        return descended(begun, values, 0, rate)
    found: list[tuple[float, int, LoadFit]] = []
    for _, _, begun, values, rate in kept[:_KEPT]:
        fit = _own_rate(descended(begun, values, _STEPS[0], rate))
        bare = float(np.std(problem.quasi_static_misfit(quasi_static, fit.rate)))
        found.append((fit.rms / bare, len(found), fit))
    share, _, best = min(found, key=lambda each: each[:2])
    hopeless = share > _HOPELESS[1] or best.dynamics.frequency > _TOO_FAST * high
    return best if hopeless else best_split(best)


def _own_rate(found: LoadFit) -> LoadFit:
    """Go on with an observer for the frequency that was found, and the model about it."""
    problem = found.problem.with_load(found.dynamics)
    return descended(problem, carried(found, problem, found.gap), _STEPS[0], OBSERVER * found.dynamics.frequency)


def best_split(found: LoadFit) -> LoadFit:
    """The best of the fits that begin with other shares of the lost motion as gap."""
    tried = [found, *(found.split(share * found.lost, _STEPS[0], True) for share in _SHARES)]
    best = _own_rate(min(tried, key=lambda each: each.rms)).again(_STEPS[1])
    for _ in range(_ROUNDS):
        # Contacts that come or go with a step end a descent: it goes on from other lost motions as well.
        again = [_own_rate(best), *(best.split(share * best.gap, _STEPS[0], True) for share in _NEAR)]
        better = min(again, key=lambda each: each.rms)
        if better.rms > _GAIN * best.rms:
            break
        best = better.again(_STEPS[1])
    return best
