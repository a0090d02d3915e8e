"""Models of a window, and that of a load behind an elastic shaft that is free in the gap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.output_error.one_mass import run_one_mass
from servotwin.estimation.output_error.shaft import run_shaft
from servotwin.hybrid.exponential import expm1
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain

# Largest rate of the flow times a part of a sample: a flank touched and left within a part is not seen; and for the
# Taylor series to converge.
_FINE, _CONVERGES = 0.4, 1.2
FRICTION_PARTS = 3  # of a sample with friction, whose sign changes between parts only
_OWN = (1.0,) * 6  # factors of the model's own numbers
_KNOWN = 0.5  # of a damping's usual spread: below it windows told of it


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
    factor on a number that is hardly ever known. A `positive` one is never below 0. A `first` one is of the window's
    first sample, so that another window says nothing of it.
    """

    name: str
    std: float
    unit: str
    positive: bool = False
    first: bool = False


class FittedModel(Protocol):
    """Model of a window: its unknowns, of which the first is the half gap at the load, and its observer's rate, 1/s.

    `root` (u, u) times the unknowns has unit covariance by what is known of them beforehand, and 0 where nothing is.
    `slowing`: a slower rate of the observer and that of the last fits, over the first.
    """

    @property
    def unknowns(self) -> tuple[Unknown, ...]: ...
    @property
    def root(self) -> Array: ...
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


def independent(unknowns: Sequence[Unknown]) -> Array:
    """(u, u) `root` of unknowns that are known independently of each other."""
    return np.diag([1.0 / unknown.std for unknown in unknowns])


HALF, OFFSET, DELAY, RATIO = range(4)
LEARNT = {"shaft stiffness": 0, "shaft damping": 1, "mass ratio": 3}
"""Unknowns of `ShaftModel` that are learnt, with their places in `servotwin.estimation.whitened.free_model.FACTORS`."""


def common(priors: Priors) -> tuple[Unknown, ...]:
    """Unknowns of every model of the load's motion, the first ones."""
    return (
        Unknown("half gap", math.inf, "load"),
        Unknown("offset", math.inf, "load"),
        Unknown("delay", priors.delay, "time"),
        Unknown("ratio", priors.ratio, "factor"),
    )


def other_friction(axis: Axis, factor: float) -> float:
    """Friction of the load (N; rotary: N m) beyond the stated Coulomb friction: by its fitted factor, a logarithm, and
    where it falls with the speed."""
    return abs(math.expm1(factor)) * axis.load.friction + axis.guide.stribeck.drop


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
    """Chain of masses behind an elastic shaft that is free in the gap.

    Attributes
    ----------
    axis : Axis
        With the numbers that are known best.
    priors : Priors
    learnt : (4, 4) array, optional
        Covariance of the logarithms of stiffness, damping, ratio and ratio of the masses, in place of their `priors`.
    friction : float, optional
        Standard deviation of the logarithm of the load's friction, where it is known; None: it is as hardly known as a
        damping.
    """

    axis: Axis
    priors: Priors
    learnt: Array | None = None
    friction: float | None = None

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
        own = (known.stiffness, known.damping, known.ratio, known.mass_ratio)
        stiffness, damping, ratio, mass_ratio = own if self.learnt is None else np.sqrt(np.diag(self.learnt)).tolist()
        factors = [Unknown("shaft stiffness", stiffness, "factor")]
        if self.axis.transmission.c_d > 0.0:
            unit = "factor" if damping < _KNOWN * known.damping else "damping"
            factors.append(Unknown("shaft damping", damping, unit))
        if any(load.c):
            factors.append(Unknown("load damping", known.damping, "damping"))
        if load.friction > 0.0:
            unit = "damping" if self.friction is None else "factor"
            factors.append(Unknown("load friction", self.friction or known.damping, unit))
        if load.force != 0.0:
            factors.append(Unknown("load force", known.stiffness, "factor"))
        if any(load.k):
            factors.append(Unknown("load stiffness", known.stiffness, "factor"))
        if load.n > 1:
            factors.append(Unknown("mass ratio", mass_ratio, "factor"))
        if not load.free:
            factors.append(Unknown("position offset", math.inf, "load"))
        places = [Unknown(f"q{i + 1}", math.inf, "load", first=True) for i in range(load.n)]
        speeds = [Unknown(f"v{i + 1}", math.inf, "speed", first=True) for i in range(load.n)]
        return (*common(known._replace(ratio=ratio)), *factors, *places, *speeds)

    @cached_property
    def places(self) -> tuple[tuple[int, int], ...]:
        """Of the unknowns in `LEARNT`, place there and among the unknowns."""
        names = [unknown.name for unknown in self.unknowns]
        return tuple((at, names.index(name)) for name, at in LEARNT.items() if name in names)

    @cached_property
    def root(self) -> Array:
        """(u, u), with the learnt covariance."""
        root = independent(self.unknowns)
        if self.learnt is not None:
            which, places = (np.array(each) for each in zip(*self.places, strict=True))
            root[np.ix_(places, places)] = np.linalg.inv(np.linalg.cholesky(self.learnt[np.ix_(which, which)]))
        return root

    def start(self, half: float, offset: float, first: tuple[float, float]) -> Array:
        """Unknowns (u,) at the model's numbers, for the last mass's first position and speed."""
        values = np.zeros(len(self.unknowns))
        n = self.axis.n
        values[[HALF, OFFSET]] = half, offset
        values[-2 * n : -n], values[-n:] = first
        return values

    def hidden_friction(self, values: Array) -> float:
        """Change of the half gap (m or rad at the load) that hides a load friction other than the model's own.

        Reversed slowly, the load follows its motor behind half the gap and what friction winds up of the shaft: these
        two are told apart by quick motion only. Friction that falls with the speed is another one at every speed.
        """
        named = {unknown.name: value for unknown, value in zip(self.unknowns, values.tolist(), strict=True)}
        stiffness = math.exp(named["shaft stiffness"]) * self.axis.transmission.k_d
        return other_friction(self.axis, named.get("load friction", 0.0)) / stiffness

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
        run = run_one_mass if self.axis.n == 1 else run_shaft
        run(
            made.drive,
            made.parts,
            made.interval,
            made.half,
            *made.matrices,
            measured - made.zero,
            gains(rate, interval),
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


def usual_sizes(unknowns: Sequence[Unknown], travel: float, duration: float, interval: float, **more: float) -> Array:
    """(u,) usual sizes of unknowns on a window of a travel (m or rad at the load); `more`: those of other units."""
    sizes = {"load": travel, "speed": travel / duration, "time": interval, "factor": 1.0, "damping": 1.0, **more}
    return np.array([sizes[unknown.unit] for unknown in unknowns])


def gains(rate: float, interval: float) -> tuple[float, float]:
    """Of an observer of a free mass that is measured at intervals (s): both errors fade at the rate (1/s)."""
    faded = -math.expm1(-rate * interval)
    return -math.expm1(-2.0 * rate * interval), faded * faded / interval


@lru_cache(maxsize=64)
def _matrices(axis: Axis, factors: tuple[float, ...], interval: float) -> tuple[Array, Array, Array, float, int]:
    """Flows and steps (2, size, size) in the gap and in contact, the force's row, the rate at which the stretch fades,
    parts of a sample that are needed."""
    flows, push, fading = _flows(axis, factors)
    kept = len(push) - 3
    parts = max(_least_parts(axis, interval), math.ceil(fastest(flows) * interval / _CONVERGES))
    steps = np.eye(flows.shape[-1]) + np.array([expm1(flow, interval / parts) for flow in flows])
    left = math.exp(-fading * interval / parts)
    steps[0, kept] = steps[0, 0]
    steps[0, kept, [0, kept]] += -left, left
    return flows, steps, push, fading, parts


@lru_cache(maxsize=64)
def _least_parts(axis: Axis, interval: float) -> int:
    """Parts of a sample at the model's own numbers: with more of them elsewhere a fit would not be smooth."""
    flows, _, _ = _flows(axis, _OWN)
    return fine_parts(fastest(flows), axis.load.friction > 0.0, interval)


def fine_parts(rate: float, friction: bool, interval: float) -> int:
    """Parts of a sample (s) in which a flow of a largest rate (1/s) turns little, and friction may change its sign."""
    return max(FRICTION_PARTS if friction else 1, math.ceil(rate * interval / _FINE))


def fastest(flows: Array) -> float:
    """Largest rate (1/s) of flows (..., size, size)."""
    return float(np.max(np.abs(np.linalg.eigvals(flows))))


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
