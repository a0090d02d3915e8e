"""The model of a load with Coulomb friction behind a screw that the gap holds: the play operator, then a chain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.output_error.models import (
    Motion,
    Priors,
    Unknown,
    common,
    fastest,
    fine_parts,
    gains,
    independent,
    other_friction,
)
from servotwin.estimation.output_error.shaft import between, slow_after, slow_before
from servotwin.hybrid.compiled import bare, inlined
from servotwin.hybrid.exponential import expm1
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array
from servotwin.plant.structure import Chain, chain, tridiagonal

STIFFNESS, DAMPING, FRICTION, FORCE, MASS_RATIO = "stiffness", "damping", "load friction", "load force", "mass ratio"
_OBSERVED = 0.25  # of the chain's slowest frequency: a faster observer hides which way friction pushes
_SAMPLES_A_RADIAN = 6.0  # of the chain's fastest frequency
_OWN = (1.0, 1.0, 1.0)  # factors of the model's own numbers
_REMEMBERED = 8  # matrices


class MovingChain(NamedTuple):
    """The masses that the screw moves, with the springs and dampers between them: (n,) arrays as of `chain`.

    `k_d` and `c_d` are between the screw and the first of them.
    """

    m: Array
    k: Array
    c: Array
    k_d: float
    c_d: float

    @classmethod
    def of(cls, axis: Axis) -> MovingChain:
        """Behind a rigid transmission the first mass is the screw's own, and the second spring holds the others."""
        load = axis.load
        m, k, c = load.masses, load.stiffnesses, load.dampings
        if not axis.rigid:
            return cls(m, k, c, axis.transmission.k_d, axis.transmission.c_d)
        return cls(m[1:], np.array([0.0, *k[2:]]), np.array([0.0, *c[2:]]), float(k[1]), float(c[1]))

    def scaled(self, k: float, c: float, last: float) -> MovingChain:
        """With factors on all stiffnesses, on all dampings, and on the last mass."""
        masses = self.m.copy()
        masses[-1] *= last
        return MovingChain(masses, k * self.k, c * self.c, k * self.k_d, c * self.c_d)

    def links(self) -> Chain:
        """Its matrices."""
        return chain(self.m, self.k, self.c, self.k_d, self.c_d)

    def frequencies(self) -> Array:
        """(2 n,) rad/s, sizes of its poles."""
        return np.abs(np.linalg.eigvals(self.links().A))

    def flexibility(self) -> float:
        """Displacement of the last mass per force on it, m/N (rotary: rad/(N m)), the screw held."""
        stiffness = tridiagonal(self.k)
        stiffness[0, 0] += self.k_d
        return float(np.linalg.inv(stiffness)[-1, -1])

    def static_gain(self) -> float:
        """Last mass's position over the screw's, at rest."""
        return float(self.links().equilibrium(1.0)[self.m.size - 1])


def follows(axis: Plant) -> bool:
    """True where the load is the screw itself, and has no motion of its own."""
    return axis.rigid and axis.n == 1


def lever(axis: Axis) -> float:
    """Travel of the load at rest per angle of the motor, m/rad (rotary: rad/rad)."""
    held = axis.backlash_kind is not BacklashKind.FREE and not follows(axis)
    return axis.p * (MovingChain.of(axis).static_gain() if held else 1.0)


@dataclass(frozen=True)
class HeldChainModel:
    """The play operator, and a chain of masses with friction at the last one.

    All positions are counted as those of the last mass at rest: the screw's times the chain's static gain.

    Attributes
    ----------
    axis : Axis
        With a transmission that is held in the gap.
    priors : Priors
    friction : float, optional
        As of `ShaftModel`.
    """

    axis: Axis
    priors: Priors
    friction: float | None = None

    @cached_property
    def moving(self) -> MovingChain:
        """The masses behind the screw."""
        return MovingChain.of(self.axis)

    @cached_property
    def speed(self) -> float:
        """Rate of the first observer, 1/s."""
        return _OBSERVED * float(self.moving.frequencies().min())

    def decimation(self, interval: float, most: int) -> int:
        """Factor, at most `most`, by which samples at an interval (s) may be fewer: no more shows of the chain."""
        needed = 1.0 / (_SAMPLES_A_RADIAN * float(self.moving.frequencies().max()))
        return max(1, min(int(needed / interval), most))

    @property
    def slowing(self) -> tuple[float, float]:
        """Nothing makes the cost rugged here: the last fits see all but the slowest motion."""
        return 0.5, 0.2

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Half gap, offset of the motor's encoder, delay, ratio; factors; first place of the screw, then positions and
        speeds of the masses."""
        known, load, n = self.priors, self.axis.load, self.moving.m.size
        factors = [Unknown(STIFFNESS, known.stiffness, "factor")]
        if any(self.moving.c) or self.moving.c_d > 0.0:
            factors.append(Unknown(DAMPING, known.damping, "damping"))
        if load.friction > 0.0:
            unit = "damping" if self.friction is None else "factor"
            factors.append(Unknown(FRICTION, self.friction or known.damping, unit))
        if load.force != 0.0:
            factors.append(Unknown(FORCE, known.stiffness, "factor"))
        if n > 1:
            factors.append(Unknown(MASS_RATIO, known.mass_ratio, "factor"))
        places = [Unknown(name, math.inf, "load", first=True) for name in ("first place", *_numbered("q", n))]
        speeds = [Unknown(name, math.inf, "speed", first=True) for name in _numbered("v", n)]
        return (*common(known), *factors, *places, *speeds)

    @cached_property
    def root(self) -> Array:
        """(u, u), diagonal."""
        return independent(self.unknowns)

    def _step(self, factors: tuple[float, ...], interval: float) -> Array:
        """(size, size) exponential over a part of a sample, of (q (n), v (n), screw, its rate, share of the force)."""
        known, numbers = self._steps, (interval, *factors)
        if numbers not in known:
            if len(known) == _REMEMBERED:
                known.pop(next(iter(known)))
            flow = self._flow(factors)
            known[numbers] = np.eye(len(flow)) + expm1(flow, interval / self._parts(interval))
        return known[numbers]

    @cached_property
    def _steps(self) -> dict[tuple[float, ...], Array]:
        """The last few: most derivatives move another unknown than the chain's numbers."""
        return {}

    def _parts(self, interval: float) -> int:
        """Parts of a sample at the model's own numbers: with more of them elsewhere a fit would not be smooth."""
        return fine_parts(self._rate, self.axis.load.friction > 0.0, interval)

    @cached_property
    def _rate(self) -> float:
        """Largest of the flow at the model's own numbers, 1/s."""
        return fastest(self._flow(_OWN))

    def _flow(self, factors: tuple[float, ...]) -> Array:
        """(size, size) flow; the screw's position is counted as that of the last mass at rest."""
        moving = self.moving.scaled(*factors)
        links, n = moving.links(), moving.m.size
        flow, kept, unit = np.zeros((2 * n + 3, 2 * n + 3)), 2 * n, self._unit
        flow[:kept, :kept] = links.A
        flow[:kept, kept], flow[:kept, kept + 1] = unit * links.B_position, unit * links.B_velocity
        flow[kept, kept + 1] = 1.0
        flow[kept - 1, kept + 2] = self.axis.load.force / moving.m[-1]
        return flow

    @cached_property
    def _unit(self) -> float:
        """Position of the screw over that of the last mass at rest."""
        return 1.0 / self.moving.static_gain()

    @cached_property
    def _names(self) -> tuple[str, ...]:
        return tuple(unknown.name for unknown in self.unknowns)

    def start(self, half: float, offset: float, first: tuple[float, float]) -> Array:
        """Unknowns (u,) at the model's numbers, for the last mass's first position and speed."""
        values, n = np.zeros(len(self.unknowns)), self.moving.m.size
        values[[0, 1]] = half, offset
        values[-2 * n - 1 : -n], values[-n:] = first
        return values

    def hidden_friction(self, values: Array) -> float:
        """Change of the half gap (m or rad at the load) that hides a load friction other than the model's own."""
        named = dict(zip(self._names, values.tolist(), strict=True))
        softness = math.exp(-named[STIFFNESS]) * self.moving.flexibility()
        return softness * other_friction(self.axis, named.get(FRICTION, 0.0))

    def believes(self, values: Array, width: float) -> bool:
        """Tell whether the friction of unknowns (u,) is within a half-width of the stated one, which does not fall."""
        factor = dict(zip(self._names, values.tolist(), strict=True)).get(FRICTION, 0.0)
        return abs(math.expm1(factor)) <= width and self.axis.guide.stribeck.drop == 0.0

    def simulate(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Motion:
        """Motion under the motor's motion (N,) at the load, for unknowns (u,).

        With a `rate` (1/s) above 0 an observer of that speed pulls the last mass towards the measured position (N,).
        """
        named = dict(zip(self._names, values.tolist(), strict=True))
        n, ratio = self.moving.m.size, math.exp(named["ratio"])
        factors = tuple(math.exp(named.get(name, 0.0)) for name in (STIFFNESS, DAMPING, MASS_RATIO))
        step, parts = self._step(factors, interval), self._parts(interval)
        friction = math.exp(named.get(FRICTION, 0.0)) * self.axis.load.friction / self.moving.m[-1]
        state = np.concatenate([values[-2 * n :], [named["first place"], 0.0, math.exp(named.get(FORCE, 0.0))]])
        out, sides = np.empty((3, drive.size)), np.empty(drive.size, dtype=np.int8)
        part = interval / parts
        run_held_chain(
            ratio * drive + named["offset"],
            parts,
            part,
            ratio * abs(named["half gap"]),
            step,
            measured,
            gains(rate, interval),
            0.5 * friction * part,
            np.empty(state.size),
            state,
            out,
            sides,
        )
        position, velocity, screw = out
        return Motion(position, velocity, screw, sides)

    def position(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Array:
        """Position (N,) of the last mass in `simulate`."""
        return self.simulate(drive, measured, interval, values, rate).position


def _numbered(name: str, count: int) -> list[str]:
    return [f"{name}{i + 1}" for i in range(count)]


@inlined
def pulled(step: Array, state: Array, screw: float, rate: float, after: Array) -> None:
    """Advance positions and speeds of a `state` by a `step`, under a screw at a place with a rate; two sums side by
    side."""
    n, kept = (state.size - 3) // 2, state.size - 3
    for i in range(kept):
        place = step[i, kept] * screw + step[i, kept + 1] * rate + step[i, kept + 2] * state[kept + 2]
        speed = 0.0
        for j in range(n):
            place += step[i, j] * state[j]
            speed += step[i, n + j] * state[n + j]
        after[i] = place + speed
    for i in range(kept):
        state[i] = after[i]


@bare
def run_held_chain(
    drive: Array,
    parts: int,
    interval: float,
    half: float,
    step: Array,
    measured: Array,
    gains: tuple[float, float],
    friction: float,
    after: Array,
    state: Array,
    motion: Array,
    sides: NDArray[np.int8],
) -> None:
    """Simulate the load.

    Parameters
    ----------
    drive, parts, interval, half, measured, gains, friction, motion, sides
        As of `run_shaft`; the driven end is the screw.
    step : (size, size) array
        Exponential over a part, of (q (n), v (n), screw, its rate, share of the force); size = 2 n + 3.
    after : (size,) array
        Scratch.
    state : (size,) array
        At the first sample; changed.
    """
    n, kept = (state.size - 3) // 2, state.size - 3
    screw = min(max(state[kept], drive[0] - half), drive[0] + half)
    for i in range(drive.size):
        error = measured[i] - state[n - 1]
        motion[0, i], motion[1, i], motion[2, i] = state[n - 1], state[2 * n - 1], screw
        lead = drive[i] - screw
        sides[i] = 0 if abs(lead) < half * (1.0 - 1e-9) else (1 if lead > 0.0 else -1)
        state[n - 1] += gains[0] * error
        state[2 * n - 1] += gains[1] * error
        if i + 1 == drive.size:
            break
        for k in range(parts):
            motor = between(drive, i, (k + 1.0) / parts)
            end = min(max(screw, motor - half), motor + half)
            place, unused = state[n - 1], slow_before(state, friction)
            pulled(step, state, screw, (end - screw) / interval, after)
            slow_after(state, place, unused, friction)
            screw = end
