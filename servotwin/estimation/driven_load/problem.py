"""A recording as a fit of a driven load: two masses, of which the motor's motion is measured."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servotwin.control.controller import Controller
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.output_error.models import DELAY, Flags, Priors, ShaftModel
from servotwin.estimation.output_error.problem import delayed
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.signals import Array
from servotwin.plant.transmission import Transmission

LARGEST = 4.0
"""Standard deviations by which an unknown may move; beyond lies a bound."""
WIDE = Priors(stiffness=1.0, damping=2.0, mass_ratio=1.0, ratio=0.05, delay=0.0)
"""Priors, but the delay's, of a machine of which nothing is known."""
_LATE = 1.0  # samples by which a channel may be late besides the lag
_FIRST = 0.02  # of the recording: what shows the first speed
_VISCOUS = 0.05  # of the critical damping: where the load's own damping begins
_SAMPLES = 12.0  # in a period of the fastest load: between two the motor is taken to move evenly
_BEYOND, _LEAST_LIMIT = 1.5, 0.1  # times that one: a faster load costs time, and says nothing; least limit
_MOST_DAMPED = 4.0  # of the critical damping: such a load does not swing
_ENDS = (0.002, 0.998)
_FACTORS = ("shaft stiffness", "shaft damping", "load damping", "load friction", "load stiffness", "mass ratio")
_NONE = Controller(0.0, 0.0, 0.0, 1.0)


class Links(NamedTuple):
    """Masses of a load that is a chain, from the spring outwards, and the links between each and the one before it.

    Attributes
    ----------
    masses : tuple of float
        n, of which the sum is 1.
    stiffnesses : tuple of float
        n - 1, over the stiffness of the spring.
    dampings : tuple of float
        n - 1, as shares of the critical damping of the load as one mass.
    """

    masses: tuple[float, ...] = (1.0,)
    stiffnesses: tuple[float, ...] = ()
    dampings: tuple[float, ...] = ()


ONE_MASS = Links()


@dataclass(frozen=True)
class LoadDynamics:
    """A load behind a spring, per unit of its mass.

    Attributes
    ----------
    frequency : float
        Of the load on the locked motor, rad/s.
    damping : float
        Of the spring, as a share of the critical one.
    friction : float
        Coulomb friction over the stiffness: how far the spring winds up while the load slides, the load's unit.
    viscous : float
        Of the load on the ground, as a share of the critical damping.
    links : Links
        One mass, or a chain of which the last mass rubs and has the encoder.
    """

    frequency: float
    damping: float
    friction: float
    viscous: float = _VISCOUS
    links: Links = ONE_MASS

    @property
    def name(self) -> str:
        """Of the model, the motor's mass included."""
        n = len(self.links.masses)
        return "two masses" if n == 1 else f"chain of {n + 1} masses"

    @property
    def compliance(self) -> float:
        """From the motor to the last mass, over that of the spring."""
        return 1.0 + sum(1.0 / each for each in self.links.stiffnesses)

    def machine(self) -> Axis:
        """An axis of this load, its mass one, behind a motor that moves as it likes."""
        k = self.frequency**2
        shaft = Transmission(1.0, k, 2.0 * self.damping * self.frequency, in_gap="free")
        inner = tuple(2.0 * each * self.frequency for each in self.links.dampings)
        load = Load(
            self.links.masses,
            (0.0, *(k * each for each in self.links.stiffnesses)),
            (2.0 * self.viscous * self.frequency, *inner),
            friction=k * self.friction,
        )
        return Axis(TorqueDrive(1.0), shaft, load, _NONE)

    def moved(self, model: ShaftModel, values: Array) -> LoadDynamics:
        """The load at unknowns (u,) of a model that began here."""
        named = dict(zip((each.name for each in model.unknowns), values.tolist(), strict=True))
        factor = {name: math.exp(named.get(name, 0.0)) for name in _FACTORS}
        *inner, last = self.links.masses
        masses = (*inner, last * factor["mass ratio"])
        total, stiffness = sum(masses), factor["shaft stiffness"]
        faster = math.sqrt(stiffness / total)
        drag = factor["load damping"] / (total * faster)
        links = Links(
            tuple(each / total for each in masses),
            tuple(each * factor["load stiffness"] / stiffness for each in self.links.stiffnesses),
            tuple(each * drag for each in self.links.dampings),
        )
        return LoadDynamics(
            self.frequency * faster,
            self.damping * factor["shaft damping"] / (total * faster),
            self.friction * factor["load friction"] / stiffness,
            self.viscous * drag,
            links,
        )


@dataclass(frozen=True, eq=False)
class DrivenLoad:
    """A recording and a model of its load, as the fits of `servotwin.estimation.output_error` take a problem.

    The motor's angle, at uniform times, drives the model; its position is compared with the load's.
    Cyclic errors are linear: the misfit is what they leave.

    Attributes
    ----------
    dynamics : LoadDynamics
        Where the fit begins.
    recording : EncoderRecording
    ratio : float
        Load per motor, in the units of the recording.
    lag : float
        s, by which the load is late besides the model's delay.
    cycles : tuple of float
        Periods of cyclic errors, the motor's unit.
    """

    dynamics: LoadDynamics
    recording: EncoderRecording
    ratio: float
    lag: float
    cycles: tuple[float, ...]

    @cached_property
    def model(self) -> ShaftModel:
        """Chain of one mass, of which little is known."""
        return ShaftModel(self.dynamics.machine(), WIDE._replace(delay=_LATE * self.interval))

    def with_load(self, dynamics: LoadDynamics) -> DrivenLoad:
        """The same recording with another load to begin with; what was prepared of it is kept."""
        other = replace(self, dynamics=dynamics)
        for name in ("interval", "_grid", "drive", "position", "_cyclic"):
            other.__dict__[name] = getattr(self, name)
        return other

    @cached_property
    def interval(self) -> float:
        return float(np.median(np.diff(self.recording.time)))

    @cached_property
    def _grid(self) -> Array:
        time = self.recording.time
        return np.asarray(time[0] + self.interval * np.arange(max(2, math.ceil(np.ptp(time) / self.interval) + 1)))

    @cached_property
    def drive(self) -> Array:
        """(N,) motor at the load, uniform in time."""
        return np.asarray(self.ratio * np.interp(self._grid - self.lag, self.recording.time, self.recording.motor))

    @cached_property
    def position(self) -> Array:
        """(N,) load, uniform in time."""
        return np.interp(self._grid, self.recording.time, self.recording.load)

    @cached_property
    def _cyclic(self) -> Array:
        """(m, c) orthonormal columns of the cyclic errors."""
        motor = np.interp(self._grid, self.recording.time, self.recording.motor)
        waves = [wave(2.0 * np.pi / period * motor) for period in self.cycles for wave in (np.sin, np.cos)]
        return np.linalg.qr(np.array(waves).T)[0] if waves else np.zeros((motor.size, 0))

    @property
    def lead(self) -> Array:
        """(N,) motor before the load, the load's unit."""
        return np.asarray(self.drive - self.position)

    @cached_property
    def range(self) -> float:
        """Of the lead, single samples aside."""
        low, high = np.quantile(self.lead, _ENDS)
        return float(high - low)

    @property
    def duration(self) -> float:
        return float(np.ptp(self.recording.time))

    @property
    def fastest(self) -> float:
        """Natural frequency of the fastest load that the samples show, rad/s."""
        return 2.0 * math.pi / (_SAMPLES * self.interval)

    @property
    def count(self) -> float:
        return 0.0

    @property
    def free(self) -> Flags:
        """(u,) unknowns that are fitted: all."""
        return np.ones(len(self.model.unknowns), dtype=bool)

    def sizes(self) -> Array:
        """(u,) usual sizes of the unknowns."""
        speed = self.range * self.model.speed
        sizes = {"load": self.range, "speed": speed, "time": self.interval, "factor": 1.0, "damping": 1.0}
        return np.array([sizes[unknown.unit] for unknown in self.model.unknowns])

    def limits(self) -> Array:
        """(u,) largest sizes of the unknowns: a load that nearly is too fast for the samples, or hardly swings.

        A faster or stiffer one costs time, and says nothing.
        """
        most = {
            "shaft stiffness": 2.0 * math.log(_BEYOND * self.fastest / self.dynamics.frequency),
            "shaft damping": _room(self.dynamics.damping),
            "load damping": _room(self.dynamics.viscous),
        }
        return np.array(
            [
                min(LARGEST * unknown.std, max(most.get(unknown.name, math.inf), _LEAST_LIMIT))
                for unknown in self.model.unknowns
            ]
        )

    def start(self, half: float, offset: float) -> Array:
        """Unknowns (u,) of a half gap and an offset of the motor, both at the load."""
        size = max(8, round(_FIRST * self.position.size))
        slope, value = np.polyfit(self.interval * np.arange(size), self.position[:size], 1)
        return self.model.start(half, offset, (float(value), float(slope)))

    def misfit(self, values: Array, rate: float = 0.0) -> Array:
        """(m,) position that an observer of that rate (1/s) predicts, less the measured one, without what is cyclic.

        A load that is weakly damped and hits its flanks has no motion that could be simulated for long: the smallest
        difference grows. Its next motion can be predicted.
        """
        drive = delayed(self.drive, float(values[DELAY]) / self.interval)
        position = self.model.simulate(drive, self.position, self.interval, values, rate).position
        return self.without_cycles(position - self.position)

    def misfits(self, points: list[Array], rate: float = 0.0) -> list[Array]:
        """`misfit` (m,) at several points."""
        return [self.misfit(values, rate) for values in points]

    def without_cycles(self, left: Array) -> Array:
        """(m,) less what is cyclic in it."""
        return np.asarray(left - self._cyclic @ (self._cyclic.T @ left))

    def quasi_static_misfit(self, predicted: Array, rate: float) -> Array:
        """(m,) misfit of a model that predicts the load (N,) from the motor alone, under the same observer."""
        # Here, because scipy.signal takes long to import and most logs need no dynamics.
        from scipy.signal import lfilter

        place, speed = 2.0 * rate * self.interval, rate * rate * self.interval
        # Corrections of position and speed by shares of the error: a filter of second order from misfit to misfit.
        step = self.interval
        over = [1.0, -2.0, 1.0]
        under = [1.0, place + step * speed - 2.0, 1.0 - place]
        return self.without_cycles(np.asarray(lfilter(over, under, predicted - self.position)))

    def grid(self, gap: float) -> list[list[Array]]:
        """One start: others come with other models."""
        return [[self.start(gap, 0.0)]]

    def on_one_flank(self, values: Array) -> list[list[Array]]:
        """None: a lost motion shows both."""
        return [[values]]


def _room(damping: float) -> float:
    """Logarithm of the factor from a damping to the largest one."""
    return math.log(_MOST_DAMPED / damping) if damping > 0.0 else math.inf
