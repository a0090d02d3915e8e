"""Motion of a motor and a load behind an elastic screw that the gap holds, under the motor's command.

In contact the screw's spring and damper act back on the motor; in the gap, and while the motor rests, the screw
carries the load.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.estimation.motor_side.drive import MotorDrive
from servotwin.estimation.motor_side.held_motor import CONTACT, REST, HeldSteps, run_held_motor
from servotwin.estimation.output_error.models import HALF, OFFSET, Priors, Unknown, common, fastest, fine_parts
from servotwin.hybrid.exponential import expm1
from servotwin.plant.actuator import Actuator
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain

SCREW, SPRINGS, DAMPING, MASS_RATIO = "screw stiffness", "load stiffness", "load damping", "mass ratio"
FRICTION, FORCE, DAMPER = "load friction", "load force", "screw damping"
_LEAST_PARTS = 8  # of a sample, as of `free_motion`


class HeldFactors(NamedTuple):
    """Factors on the load's numbers and on what its force does to the motor."""

    screw: float = 1.0
    springs: float = 1.0
    damping: float = 1.0
    mass_ratio: float = 1.0
    force: float = 1.0
    reaction: float = 1.0
    damper: float = 1.0


@dataclass(frozen=True)
class HeldShaft:
    """Chain of masses behind an elastic screw whose driven end the gap holds; places are counted at that end.

    Attributes
    ----------
    axis : Axis
        With the numbers that are known best.
    priors : Priors
    screw : float
        Relative standard deviation of the screw's stiffness beforehand.
    """

    axis: Axis
    priors: Priors
    screw: float

    @cached_property
    def speed(self) -> float:
        """Rate of the first observer, 1/s: the slowest frequency of the load behind a screw at rest."""
        return float(np.abs(np.linalg.eigvals(self.axis.chain().A)).min())

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Half gap, and three that are not fitted; factors; first place of the screw, places and speeds of the
        masses."""
        load, known, numbers = self.axis.load, self.priors, range(1, self.axis.n + 1)
        factors = {
            Unknown(SCREW, self.screw, "factor"): True,
            Unknown(SPRINGS, known.stiffness, "factor"): any(load.k),
            Unknown(DAMPING, known.damping, "damping"): any(load.c),
            Unknown(DAMPER, known.damping, "damping"): self.axis.transmission.c_d > 0.0,
            Unknown(FRICTION, known.damping, "damping"): load.friction > 0.0,
            Unknown(FORCE, known.stiffness, "factor"): load.force != 0.0,
            Unknown(MASS_RATIO, known.mass_ratio, "factor"): load.n > 1,
        }
        places = [Unknown(name, math.inf, "load", first=True) for name in ("first place", *(f"q{i}" for i in numbers))]
        speeds = [Unknown(f"v{i}", math.inf, "speed", first=True) for i in numbers]
        return (*common(known), *(unknown for unknown, there in factors.items() if there), *places, *speeds)

    def start(self, half: float, offset: float, first: tuple[float, float]) -> Array:
        """Unknowns (u,) at the model's numbers, for the screw's first place and speed; the load goes with it."""
        values, n, at_rest = np.zeros(len(self.unknowns)), self.axis.n, self.axis.chain().equilibrium
        values[[HALF, OFFSET]], (place, speed) = (half, offset), first
        values[-2 * n - 1 :] = place, *at_rest(place)[:n], *at_rest(speed)[:n]
        return values

    def parts(self, interval: float) -> int:
        """Parts of a sample (s), at the model's own numbers: with more of them elsewhere a fit would not be smooth."""
        return max(_LEAST_PARTS, fine_parts(self._fastest, self.axis.load.friction > 0.0, interval))

    @cached_property
    def _fastest(self) -> float:
        """Largest rate of motor and load in contact, 1/s."""
        flow = _flows(self.axis, self.axis.actuator, HeldFactors())[CONTACT]
        mechanical = slice(len(self.axis.shaft().names) - 2, -2)
        return fastest(flow[mechanical, mechanical])


def held_motion(shaft: HeldShaft, drive: MotorDrive, values: Array, gains: Array) -> tuple[Array, Array]:
    """(N,) angle of the motor as predicted by an observer with `gains`, and driven end, both at the load, for the
    unknowns (u,) of the load."""
    axis, n, parts = shaft.axis, shaft.axis.n, shaft.parts(drive.interval)
    known = {unknown.name: value for unknown, value in zip(shaft.unknowns, values.tolist(), strict=True)}
    factors, part = _factors(known, drive.reaction), drive.interval / parts
    rubs = math.exp(known.get(FRICTION, 0.0)) * axis.load.friction / (factors.mass_ratio * axis.load.m[-1])
    by = HeldSteps(
        _steps(axis, drive.actuator, factors, part),
        n,
        part,
        abs(known["half gap"]),
        axis.p * float(axis.shaft().E[-2]) * drive.friction * part,
        rubs * part,
    )
    # Places and speeds of the masses, then the screw.
    state = np.concatenate([drive.first, values[-2 * n :], values[-2 * n - 1 : -2 * n]])
    predicted, driven = np.empty((2, drive.measured.size))
    scratch = np.empty((2, state.size))
    run_held_motor(drive.measured, drive.command, parts, by, gains, scratch, state, predicted, driven)
    return predicted, driven


def _factors(known: Mapping[str, float], reaction: float) -> HeldFactors:
    """Factors from their logarithms by name."""

    def factor(name: str) -> float:
        return math.exp(known.get(name, 0.0))

    load = factor(SPRINGS), factor(DAMPING), factor(MASS_RATIO), factor(FORCE)
    return HeldFactors(factor(SCREW), *load, reaction, factor(DAMPER))


@lru_cache(maxsize=16)
def _steps(axis: Axis, actuator: Actuator, factors: HeldFactors, interval: float) -> Array:
    """Matrices (3, M, M + 2) of `HeldSteps` over an interval (s)."""
    flows = _flows(axis, actuator, factors)
    steps = np.eye(flows.shape[-1]) + np.array([expm1(flow, interval) for flow in flows])
    return np.ascontiguousarray(steps[:, :-2])


def _flows(axis: Axis, actuator: Actuator, factors: HeldFactors) -> Array:
    """Flows (3, M + 2, M + 2) in the gap, in contact and at rest, with command and 1 as the last states."""
    load, shaft, masses = axis.load, actuator.matrices(), axis.load.masses
    masses[-1] *= factors.mass_ratio
    k_d, c_d = factors.screw * axis.transmission.k_d, factors.damper * axis.transmission.c_d
    links = chain(masses, factors.springs * load.stiffnesses, factors.damping * load.dampings, k_d, c_d)
    d = len(shaft.names)
    screw, unit = d + 2 * load.n, np.ones(d)
    unit[-2:] = axis.p
    flows, chained = np.zeros((3, screw + 3, screw + 3)), slice(d, screw)
    flows[:, :d, :d] = unit[:, None] * shaft.A / unit
    flows[:, :d, -2] = unit * shaft.B
    flows[:, chained, chained], flows[:, chained, screw] = links.A, links.B_position
    flows[:, screw - 1, -1] = factors.force * load.force / masses[-1]
    pushed = factors.reaction * axis.p * unit * shaft.E
    flows[CONTACT, :d, chained] -= np.outer(pushed, links.reaction)
    flows[CONTACT, :d, screw] -= pushed * links.reaction_position
    flows[CONTACT, screw, d - 2] = 1.0
    # The screw's damper feels the motor's speed.
    flows[CONTACT, :d, d - 2] -= pushed * links.reaction_velocity
    flows[CONTACT, chained, d - 2] += links.B_velocity
    flows[REST, d - 2 : d] = 0.0
    return flows
