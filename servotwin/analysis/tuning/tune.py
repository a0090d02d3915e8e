"""Tuning of a controller to a crossover and a phase margin, as pidtune does, for the law of this package.

Every candidate has the specified crossover and margin exactly: the angles be and al of `factors` are free, phz follows
from the phase and K from the modulus of the plant there. Of all stable ones those with the smallest Ms compete,
and the largest Ki wins; or, with ``prefer = "Ki"``, the largest Ki within a bound on Ms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servotwin.analysis.tuning.candidates import CONTROLLER_TYPES, Candidate, Factors, search
from servotwin.analysis.tuning.response import FrequencyData, Plant, nyquist_stable
from servotwin.config.table import did_you_mean
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.linear import LinearSystem, feedback, gain, series
from servotwin.plant.loop import pidf
from servotwin.plant.margins import Margins, gain_crossovers, margins, margins_of_response, search_frequencies

# Candidates whose Ms is this close to the smallest count as equal, and the largest Ki wins.
_EQUAL = 1.01


@dataclass(frozen=True)
class Specification:
    """Specification of a controller.

    Parameters
    ----------
    crossover : float
        rad/s, where abs(L) = 1.
    phase_margin : float
        rad, there; of a P controller, which cannot choose it, the least.
    kind : str
        P, PI, PD, PDF, PID or PIDF. PD and PID get the filter 0.01 / crossover, since the law needs one.
    Ms_max : float
        Largest sensitivity peak that is accepted.
    prefer : str
        "Ms": the smallest Ms, then the largest Ki. "Ki": the largest Ki (Kp without integral action) within Ms_max.

    Raises
    ------
    InvalidInput
        A value is outside its range.
    """

    crossover: float
    phase_margin: float
    kind: str = "PIDF"
    Ms_max: float = math.inf
    prefer: str = "Ms"

    def __post_init__(self) -> None:
        if self.kind not in CONTROLLER_TYPES:
            hint = did_you_mean(self.kind, tuple(CONTROLLER_TYPES))
            raise InvalidInput(
                f"controller type {self.kind!r} does not exist{hint}; give one of {', '.join(CONTROLLER_TYPES)}"
            )
        if self.prefer not in ("Ms", "Ki"):
            raise InvalidInput(f"prefer = {self.prefer!r}: must be 'Ms' or 'Ki'")
        if not (math.isfinite(self.crossover) and self.crossover > 0.0):
            raise InvalidInput(f"crossover = {self.crossover!r} rad/s: must be positive and finite")
        if not 0.0 < self.phase_margin < math.pi:
            degrees = math.degrees(self.phase_margin)
            raise InvalidInput(f"phase margin = {degrees:g} deg: must be above 0 and below 180 deg")
        if not self.Ms_max > 1.0:
            raise InvalidInput(
                f"Ms_max = {self.Ms_max!r}: must be above 1, the sensitivity of every loop at high frequency"
            )

    def cost(self, candidate: Candidate) -> float:
        """Cost that the search minimises; a candidate beyond Ms_max is worse than any within."""
        if self.prefer == "Ki" and candidate.Ms <= self.Ms_max:
            return -candidate.integral
        return candidate.Ms


@dataclass(frozen=True, repr=False)
class Tuning:
    """A controller, its margins and the statistics of the search.

    Attributes
    ----------
    controller : Controller
        Kp, Ki, Kd, Tf; everything else as in the controller that was given, or default.
    factors : Factors
        Its phases at the crossover.
    margins : Margins
        All crossovers and margins, Ms and bandwidth.
    candidates, stable : int
        Numbers of candidates evaluated, and of stable ones among them.
    """

    controller: Controller
    factors: Factors
    margins: Margins
    candidates: int
    stable: int

    def __repr__(self) -> str:
        """Controller, crossover, margin and Ms in one line."""
        return f"<Tuning {self.controller!r}: crossover {self.factors.wc:.4g} rad/s, Ms {self.margins.Ms:.3g}>"


def tune(
    system: LinearSystem | FrequencyData,
    specification: Specification,
    delay: float = 0.0,
    like: Controller | None = None,
) -> Tuning:
    """Find the best controller of a type with a given crossover and phase margin.

    Parameters
    ----------
    system : LinearSystem or FrequencyData
        Controller output to measurement: ``servo.plant()``, with a loop filter in series where there is one. Stable but
        for integrators.
    specification : Specification
    delay : float
        s, in series with it.
    like : Controller, optional
        Source of the dead zone, limits and filter of the result.

    Raises
    ------
    InvalidInput
        The plant is unstable, the type cannot give this margin at this crossover, no candidate is stable, or none has
        Ms_max; the sentence says what can be reached.
    """
    plant = Plant(system, delay)
    spec = specification
    result = search(plant, spec.kind, spec.crossover, spec.phase_margin, spec.cost)
    best = min(result.stable, key=lambda one: one.Ms)
    if not best.Ms <= spec.Ms_max:
        reached = f"the smallest Ms that a {spec.kind} controller reaches there is {best.Ms:.3f}"
        raise InvalidInput(f"Ms_max = {spec.Ms_max:g}: {reached}; lower the crossover or change the margin")
    limit = spec.Ms_max if spec.prefer == "Ki" else min(_EQUAL * best.Ms, spec.Ms_max)
    by_integral = sorted((one for one in result.stable if one.Ms <= limit), key=lambda one: -one.integral)
    for candidate in [*by_integral, best]:
        law = candidate.factors.controller()
        achieved = evaluate(system, law, delay)
        # The frequencies of the search may just miss a peak; the exact Ms decides.
        if achieved.Ms <= spec.Ms_max:
            break
    if like is not None:
        law = like.replace(Kp=law.Kp, Ki=law.Ki, Kd=law.Kd, Tf=law.Tf)
    return Tuning(law, candidate.factors, achieved, result.evaluated, len(result.stable))


def evaluate(system: LinearSystem | FrequencyData, controller: Controller, delay: float = 0.0) -> Margins:
    """All crossovers and margins, Ms and bandwidth of a controller on a plant with a delay."""
    law = pidf(controller)
    if isinstance(system, LinearSystem) and delay == 0.0:
        loop = series(law, system)
        return margins(loop, feedback(loop, gain(1.0)))
    plant = Plant(system, delay)
    omega = plant.search_frequencies(_crossover(law, system) if isinstance(system, LinearSystem) else 1.0)
    loops = law.response(omega) * plant.response(omega)
    stable = bool(nyquist_stable(loops[None, :], plant.integrators + (controller.Ki != 0.0))[0])
    return margins_of_response(lambda w: np.asarray(law.response(w) * plant.response(w)), omega, stable)


def _crossover(law: LinearSystem, system: LinearSystem) -> float:
    """Highest gain crossover, rad/s, which no delay moves; without one the frequency at which the gain is nearest 1."""
    loop = series(law, system)
    if found := gain_crossovers(loop):
        return found[-1].omega
    omega = search_frequencies(loop)
    return float(omega[np.argmin(np.abs(np.log(np.abs(loop.response(omega)))))])
