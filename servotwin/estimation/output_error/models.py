"""The two models: a load behind an elastic shaft that is free in the gap, and one mass on a rigid screw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.output_error.shaft import run_shaft
from servotwin.hybrid.compiled import bare
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play_samples
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain

# Largest rate of the flow times a part of a sample: a flank touched and left within a part is not seen; and for the
# Taylor series to converge.
_FINE, _CONVERGES = 0.4, 1.2
_PARTS = 3  # of a sample with friction, whose sign changes between parts only
_OWN = (1.0,) * 6  # factors of the model's own numbers
_CONSTANT = np.ones(1)  # size of a gap that stays as it is
_EXPONENTIAL = 20  # terms of the series, for a norm below one


Flags: TypeAlias = NDArray[np.bool_]


class Motion(NamedTuple):
    """A simulated window.

    Attributes
    ----------
    position, velocity, driven : (N,) arrays
        Last mass and driven end, at the load.
    sides : (N,) int8 array
        Flank in contact, -1, 0 or 1.
    """

    position: Array
    velocity: Array
    driven: Array
    sides: NDArray[np.int8]


class Unknown(NamedTuple):
    """One unknown of a model: name, standard deviation beforehand (inf: nothing known), and unit of its size.

    The unit is "load" (m or rad at the load), "speed" (that per s), "time" (s), "factor" (a logarithm), or "damping": a
    factor on a number that is hardly ever known. A `positive` one is never below 0.
    """

    name: str
    std: float
    unit: str
    positive: bool = False


class FittedModel(Protocol):
    """Model of a window: its unknowns, of which the first is the half gap at the load, and its observer's rate, 1/s.

    `slowing`: rates of the observer in the second fits and in the last ones, over the first.
    """

    @property
    def unknowns(self) -> tuple[Unknown, ...]: ...
    @property
    def speed(self) -> float: ...
    @property
    def slowing(self) -> tuple[float, float]: ...


class MotionModel(FittedModel, Protocol):
    """Model of the load's motion. The first two unknowns are half gap and offset, at the load."""

    def simulate(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Motion: ...
    def position(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Array: ...
    def start(self, half: float, offset: float, first: tuple[float, float]) -> Array: ...


class Priors(NamedTuple):
    """Relative standard deviations of the model's numbers beforehand, and that of the delay, s."""

    stiffness: float
    damping: float
    mass_ratio: float
    ratio: float
    delay: float


HALF, OFFSET, DELAY, RATIO = range(4)
LAG = 5  # of `PlayModel`


def _common(priors: Priors) -> tuple[Unknown, ...]:
    return (
        Unknown("half gap", math.inf, "load"),
        Unknown("offset", math.inf, "load"),
        Unknown("delay", priors.delay, "time"),
        Unknown("ratio", priors.ratio, "factor"),
    )


class PreparedShaft(NamedTuple):
    """Numbers of a simulation of `ShaftModel`, as `run_shaft` takes them.

    Attributes
    ----------
    drive : (N,) array
        Motor at the load.
    parts : int
        Of a sample.
    interval : float
        s, of a part.
    half : float
        Half gap.
    matrices : tuple
        Flows, steps, the force's row, and the rate at which the shaft's stretch fades in the gap.
    friction : float
    state : array
        At the first sample; a simulation changes it.
    zero : float
        Offset of the position.
    """

    drive: Array
    parts: int
    interval: float
    half: float
    matrices: tuple[Array, Array, Array, float]
    friction: float
    state: Array
    zero: float

    def scratch(self) -> Array:
        """Room for the Taylor series of the flow."""
        return np.empty((18 + 14 // self.state.size, self.state.size))


@dataclass(frozen=True)
class ShaftModel:
    """Chain of masses behind an elastic shaft that is free in the gap."""

    axis: Axis
    priors: Priors

    @property
    def speed(self) -> float:
        """Rate of the first observer, 1/s: the shaft's own frequency."""
        return math.sqrt(self.axis.transmission.k_d / self.axis.load.m[0])

    @property
    def slowing(self) -> tuple[float, float]:
        """Slower fits see more of the load's slow motion."""
        return 0.5, 0.15

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Half gap, offset of the motor's encoder, delay, ratio; factors; first positions and speeds of the masses."""
        load, known = self.axis.load, self.priors
        factors = [Unknown("shaft stiffness", known.stiffness, "factor")]
        if self.axis.transmission.c_d > 0.0:
            factors.append(Unknown("shaft damping", known.damping, "damping"))
        if any(load.c):
            factors.append(Unknown("load damping", known.damping, "damping"))
        if load.friction > 0.0:
            factors.append(Unknown("load friction", known.damping, "damping"))
        if load.force != 0.0:
            factors.append(Unknown("load force", known.stiffness, "factor"))
        if any(load.k):
            factors.append(Unknown("load stiffness", known.stiffness, "factor"))
        if load.n > 1:
            factors.append(Unknown("mass ratio", known.mass_ratio, "factor"))
        if not load.free:
            factors.append(Unknown("position offset", math.inf, "load"))
        places = [Unknown(f"q{i + 1}", math.inf, "load") for i in range(load.n)]
        speeds = [Unknown(f"v{i + 1}", math.inf, "speed") for i in range(load.n)]
        return (*_common(known), *factors, *places, *speeds)

    def start(self, half: float, offset: float, first: tuple[float, float]) -> Array:
        """Unknowns (u,) at the model's numbers, for the last mass's first position and speed."""
        values = np.zeros(len(self.unknowns))
        n = self.axis.n
        values[[HALF, OFFSET]] = half, offset
        values[-2 * n : -n], values[-n:] = first
        return values

    def prepared(self, drive: Array, interval: float, values: Array) -> PreparedShaft:
        """The numbers of a simulation under the motor's motion (N,) at the load, for unknowns (u,)."""
        n = self.axis.n
        named = {unknown.name: value for unknown, value in zip(self.unknowns, values.tolist(), strict=True)}
        factors = tuple(
            math.exp(named.get(name, 0.0))
            for name in (
                "shaft stiffness",
                "shaft damping",
                "load damping",
                "load stiffness",
                "mass ratio",
                "load force",
            )
        )
        flows, steps, push, fading, parts = _matrices(self.axis, factors, interval)
        friction = math.exp(named.get("load friction", 0.0)) * self.axis.load.friction / self.axis.load.m[-1]
        return PreparedShaft(
            math.exp(named["ratio"]) * drive + named["offset"],
            parts,
            interval / parts,
            math.exp(named["ratio"]) * abs(named["half gap"]),
            (flows, steps, push, fading),
            0.5 * friction * interval / parts,
            np.concatenate([values[-2 * n :], [values[-2 * n], 0.0, 1.0]]),
            named.get("position offset", 0.0),
        )

    def simulate(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Motion:
        """Motion under the motor's motion (N,) at the load, for unknowns (u,).

        With a `rate` (1/s) above 0 an observer of that speed pulls the last mass towards the measured position (N,).
        """
        made = self.prepared(drive, interval, values)
        out, sides = np.empty((3, made.drive.size)), np.empty(made.drive.size, dtype=np.int8)
        gains = 2.0 * rate * interval, rate * rate * interval
        run_shaft(
            made.drive,
            made.parts,
            made.interval,
            made.half,
            *made.matrices,
            measured - made.zero,
            gains,
            made.friction,
            made.scratch(),
            made.state,
            out,
            sides,
        )
        position, velocity, end = out
        return Motion(position + made.zero, velocity, end, sides)

    def position(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Array:
        """Position (N,) of the last mass in `simulate`."""
        return self.simulate(drive, measured, interval, values, rate).position


@lru_cache(maxsize=64)
def _matrices(axis: Axis, factors: tuple[float, ...], interval: float) -> tuple[Array, Array, Array, float, int]:
    """Flows and steps (2, size, size) in the gap and in contact, the force's row, the rate at which the stretch fades,
    parts of a sample that are needed."""
    flows, push, fading = _flows(axis, factors)
    kept = len(push) - 3
    parts = max(_least_parts(axis, interval), math.ceil(_fastest(flows) * interval / _CONVERGES))
    steps = np.array([exponential(flow * interval / parts) for flow in flows])
    left = math.exp(-fading * interval / parts)
    steps[0, kept] = steps[0, 0]
    steps[0, kept, [0, kept]] += -left, left
    return flows, steps, push, fading, parts


@lru_cache(maxsize=64)
def _least_parts(axis: Axis, interval: float) -> int:
    """Parts of a sample at the model's own numbers: with more of them elsewhere a fit would not be smooth."""
    flows, _, _ = _flows(axis, _OWN)
    return max(_PARTS if axis.load.friction > 0.0 else 1, math.ceil(_fastest(flows) * interval / _FINE))


def _fastest(flows: Array) -> float:
    return max(float(np.max(np.abs(np.linalg.eigvals(flow)))) for flow in flows)


def _flows(axis: Axis, factors: tuple[float, ...]) -> tuple[Array, Array, float]:
    """Flows (2, size, size) in the gap and in contact, the force's row, the rate at which the stretch fades."""
    k_d, c_d, c, k, ratio, force = factors
    load, shaft, n = axis.load, axis.transmission, axis.n
    masses = load.masses.copy()
    masses[-1] *= ratio
    k_d, c_d = k_d * shaft.k_d, c_d * shaft.c_d
    links = chain(masses, k * load.stiffnesses, c * load.dampings, k_d, c_d)
    size, kept = 2 * n + 3, 2 * n
    flows, push = np.zeros((2, size, size)), np.zeros(size)
    flows[0, :kept, :kept], flows[1, :kept, :kept] = links.A_open, links.A
    flows[1, :kept, kept], flows[1, :kept, kept + 1] = links.B_position, links.B_velocity
    flows[1, kept, kept + 1] = 1.0
    flows[0, kept, n] = 1.0
    push[:kept], push[kept : kept + 2] = links.reaction, (k_d, c_d)
    flows[:, kept - 1, kept + 2] = force * load.force / masses[-1]
    return flows, push, k_d / c_d if c_d > 0.0 else 0.0


def exponential(matrix: Array) -> Array:
    """Exponential of a small matrix by its series, scaled and squared: scipy's starts threads for it."""
    halvings = max(0, math.ceil(math.log2(max(1e-300, float(np.abs(matrix).sum(axis=1).max())))))
    part = matrix / 2.0**halvings
    term = result = np.eye(len(matrix))
    for k in range(1, _EXPONENTIAL):
        term = term @ part / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result


@dataclass(frozen=True)
class PlayModel:
    """One mass on a rigid screw: the play operator, and the lag of its encoder."""

    axis: Axis
    priors: Priors

    @property
    def speed(self) -> float:
        """No observer."""
        return 0.0

    @property
    def slowing(self) -> tuple[float, float]:
        """Any."""
        return 1.0, 1.0

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Half gap, offset of the position, delay, ratio, first place of the screw, lag of the position.

        Both encoders' electronics delay, and filter: a lag that is not fitted is taken for gap and delay.
        """
        return (
            *_common(self.priors),
            Unknown("first place", math.inf, "load"),
            Unknown("lag", self.priors.delay, "time", positive=True),
        )

    def start(self, half: float, offset: float, first: tuple[float, float]) -> Array:
        """Unknowns (u,) for a first position of the mass."""
        return np.array([half, offset, 0.0, 0.0, first[0], 0.0])

    def simulate(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Motion:
        """Motion under the motor's motion (N,) at the load, for unknowns (u,); there is nothing to observe."""
        del measured, rate
        driven, half, place = self._driven(drive, values)
        lead, lag = driven - place, float(values[LAG])
        sides = np.where(np.abs(lead) >= half * (1.0 - 1e-9), np.sign(lead), 0.0).astype(np.int8)
        return Motion(lagged(place, lag / interval), np.gradient(place, interval), place, sides)

    def position(self, drive: Array, measured: Array, interval: float, values: Array, rate: float) -> Array:
        """Position (N,) of the mass in `simulate`."""
        del measured, rate
        return self.position_in_growing_gap(drive, interval, values, _CONSTANT)

    def position_in_growing_gap(self, drive: Array, interval: float, values: Array, sizes: Array) -> Array:
        """Position (N,) of the mass in a gap of `sizes` (N,), shares of the one among the unknowns (u,); (1,) of one
        size."""
        return lagged(self._driven(drive, values, sizes)[2], float(values[LAG]) / interval)

    def _driven(self, drive: Array, values: Array, sizes: Array = _CONSTANT) -> tuple[Array, float, Array]:
        """Motor (N,) at the load, half gap there, and place (N,) of the screw behind a gap of `sizes` (N,) or (1,)."""
        half, offset, _, ratio, first, _ = values.tolist()
        driven, half = math.exp(ratio) * drive + offset, math.exp(ratio) * abs(half)
        return driven, half, play_samples(driven, half * sizes, first)


def lagged(values: Array, samples: float) -> Array:
    """A signal (N,) behind a first-order lag of a number of samples, straight between them."""
    out = np.empty(values.size)
    decay = math.exp(-1.0 / samples) if samples > 0.0 else 0.0
    slope = samples * (1.0 - decay)
    out[0] = values[0]
    lag(values, decay, 1.0 - slope, slope - decay, out)
    return out


@bare
def lag(values: Array, decay: float, now: float, before: float, out: Array) -> None:
    """`lagged` into `out` (N,), of which the first is there."""
    for i in range(1, values.size):
        out[i] = decay * out[i - 1] + now * values[i] + before * values[i - 1]
