"""Model of a window with the motor's angle and the command only: the motor feels the load through the shaft."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from servotwin.estimation.motor_side.motor import LoadStep, MotorStep, run_motor
from servotwin.estimation.output_error.models import (
    HALF,
    Flags,
    ShaftModel,
    Unknown,
    independent,
    usual_sizes,
)
from servotwin.estimation.output_error.problem import LARGEST, delayed
from servotwin.hybrid.exponential import expm1
from servotwin.plant.actuator import Actuator
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain

_HALVES = (0.4, 0.28, 0.2, 0.14, 0.1, 0.07, 0.05, 0.035, 0.025, 0.017, 0.012, 0.008, 0.005)  # of the motor's travel
_PLACES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of the half gap
_WIDE = 5.0  # of the motor's travel
_DOUBLINGS = 24  # of the Riccati equation: 2^24 samples
_MOVED = 0.02  # of the window: what shows the first speed
_FIXED = ("offset", "delay", "ratio", "position offset")
_MOTOR = (
    *("load inertia", "torque per command", "motor damping", "motor friction"),
    *("input bias", "command's delay", "motor's first speed"),
)
# Of a sample: the motor's speed is constant within each. A model with the true numbers left 7 to 15 counts of the
# encoder with one part, 0.4 to 2.4 with eight, and gaps were off by up to 5 %.
PARTS = 8


@dataclass(frozen=True)
class MotorModel:
    """The load's model with the motor's: its reaction accelerates the motor.

    Attributes
    ----------
    axis : Axis
    shaft : ShaftModel
    load, torque, damping, delay : float
        Standard deviations beforehand: of the load's inertia, the torque per command and the motor's friction,
        relative, and of the command's delay, s.
    """

    axis: Axis
    shaft: ShaftModel
    load: float
    torque: float
    damping: float
    delay: float

    @property
    def speed(self) -> float:
        """Rate of the first observer, 1/s: the shaft's own frequency."""
        return self.shaft.speed

    @property
    def slowing(self) -> tuple[float, float]:
        """Slower fits see more of the slow motion, and do not take one number of the model for another."""
        return 0.5, 0.15

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Those of the load's motion, and those of the motor."""
        stds = (self.load, self.torque, self.damping, self.damping, math.inf, self.delay, math.inf)
        units = ("factor", "factor", "damping", "damping", "command", "time", "speed")
        of_motor = list(map(Unknown, _MOTOR, stds, units))
        return (*self.shaft.unknowns, *of_motor[:-1], of_motor[-1]._replace(first=True))

    @cached_property
    def root(self) -> Array:
        """(u, u), diagonal."""
        return independent(self.unknowns)


@dataclass(frozen=True, eq=False)
class MotorProblem:
    """A window without the load's position.

    Attributes
    ----------
    model : MotorModel
    position : (N,) array
        Motor's angle times the transmission's ratio, m or rad.
    command : (N,) array
        As the drive follows it, in the actuator's unit.
    interval : float
        s.
    count : float
        One count of the motor's encoder, seen at the load.
    """

    model: MotorModel
    position: Array
    command: Array
    interval: float
    count: float

    @property
    def range(self) -> float:
        """Travel of the motor, at the load."""
        return float(np.ptp(self.position))

    @property
    def duration(self) -> float:
        """Of the window, s."""
        return self.interval * self.position.size

    @property
    def free(self) -> Flags:
        """(u,) unknowns that are fitted: no encoder shows where the load is."""
        return np.array([unknown.name not in _FIXED for unknown in self.model.unknowns])

    @property
    def drive(self) -> Array:
        """The same."""
        return self.position

    def sizes(self) -> Array:
        """(u,) usual sizes of the unknowns."""
        command = float(np.std(self.command)) or 1.0
        return usual_sizes(self.model.unknowns, self.range, self.duration, self.interval, command=command)

    def limits(self) -> Array:
        """(u,) largest sizes of the unknowns."""
        return np.array([LARGEST * unknown.std for unknown in self.model.unknowns])

    def simulate(self, values: Array, rate: float) -> tuple[Array, Array]:
        """(N,) angle of the motor as predicted by an observer of a rate (1/s), and driven end, both at the load."""
        axis, at = self.model.axis, self.first_speed()
        inertia, torque, damping, friction, bias, late, off = values[-len(_MOTOR) :].tolist()
        actuator = axis.actuator.scaled(math.exp(torque), math.exp(damping))
        step, by_command, by_torque, direct = _steps(actuator, axis.p, self.interval / PARTS)
        by = MotorStep(
            step,
            by_command,
            math.exp(inertia) * by_torque,
            math.exp(friction) * axis.motor_friction / axis.p * by_torque[-2],
        )
        # The load follows the simulated motor: of the measured one nothing is prepared.
        load = self.model.shaft.prepared(self.position[:1], self.interval / PARTS, values[: -len(_MOTOR)])
        command = delayed(self.command, late / self.interval) + bias
        motor = direct * command[0]
        motor[-2:] = at + off, self.position[0]
        predicted, driven = np.empty((2, self.position.size))
        run_motor(
            self.position,
            command,
            PARTS,
            by,
            LoadStep(load.parts, load.interval, load.half, *load.matrices, load.friction, *self._momentum(values)),
            _gains(axis, self.interval, rate),
            np.empty((len(load.scratch()) + 1, load.state.size)),
            motor,
            load.state,
            predicted,
            driven,
        )
        return predicted, driven

    def _momentum(self, values: Array) -> tuple[Array, tuple[float, float]]:
        """Rows of the load's momentum (2 n + 3,), stiffness to the ground, and constant force, for unknowns (u,)."""
        load, n = self.model.axis.load, self.model.axis.n
        known = zip(self.model.unknowns, values.tolist(), strict=True)
        factor = {unknown.name: math.exp(value) for unknown, value in known if unknown.unit in ("factor", "damping")}
        row = np.zeros(2 * n + 3)
        row[0] = factor.get("load damping", 1.0) * load.c[0]
        row[n : 2 * n] = load.m
        row[2 * n - 1] *= factor.get("mass ratio", 1.0)
        return row, (factor.get("load stiffness", 1.0) * load.k[0], factor.get("load force", 1.0) * load.force)

    def misfit(self, values: Array, rate: float = 0.0) -> Array:
        """(N,) angle of the motor as predicted by an observer of a rate (1/s) less the measured one, at the load."""
        return np.asarray(self.simulate(values, rate)[0] - self.position)

    def first_speed(self) -> float:
        """Speed of the motor by a line through the first samples, at the load, per s."""
        size = max(8, round(_MOVED * self.position.size))
        return float(np.polyfit(self.interval * np.arange(size), self.position[:size], 1)[0])

    def start(self, half: float, place: float) -> Array:
        """Unknowns (u,) of a load that moves with the motor, `place` half gaps off the middle of the gap."""
        values = np.zeros(len(self.model.unknowns))
        own = self.model.shaft.start(half, 0.0, (float(self.position[0]) + place * half, self.first_speed()))
        values[: own.size] = own
        return values

    def grid(self, gap: float) -> list[list[Array]]:
        """Unknowns (u,) to begin with, a list for each half gap: `gap` is an expected one at the load, 0: none."""
        halves = [share * self.range for share in _HALVES] + ([gap] if gap > 0.0 else [])
        return [self.places(half) for half in halves]

    def places(self, half: float) -> list[Array]:
        """Unknowns (u,) to begin with at a half gap, in different places of the load in it."""
        return [self.start(half, place) for place in _PLACES]

    def beside(self, values: Array) -> list[Array]:
        """Unknowns (u,) to begin with where another window had `values` (u,), in different places of the load."""
        first = [unknown.first for unknown in self.model.unknowns]
        return [np.where(first, start, values) for start in self.places(float(values[HALF]))]

    def on_one_flank(self, values: Array) -> list[list[Array]]:
        """Unknowns (u,) of a gap whose other flank is out of reach, a list for each flank, the lower one first."""
        wide, n = _WIDE * self.range, self.model.axis.n
        own = len(self.model.shaft.unknowns)
        tables = []
        for side in (-1.0, 1.0):
            tried = [values.copy() for _ in _PLACES]
            for each, place in zip(tried, _PLACES, strict=True):
                each[HALF] = wide
                off = 0.5 * (1.0 + place) * 2.0 * abs(values[HALF])
                each[own - 2 * n : own - n] = self.position[0] - side * (wide - off)
            tables.append(tried)
        return tables


@lru_cache(maxsize=64)
def _steps(motor: Actuator, p: float, interval: float) -> tuple[Array, Array, Array, Array]:
    """Step (d, d) of the actuator over an interval (s), speed and angle at the load (ratio p), columns (d,) of a held
    command and of a force at the load, and states per command of a motor that is held."""
    shaft = motor.matrices()
    size = len(shaft.names)
    unit = np.ones(size)
    unit[-2:] = p
    flow = np.zeros((size + 2, size + 2))
    flow[:size, :size] = unit[:, None] * shaft.A / unit
    flow[:size, size], flow[:size, size + 1] = unit * shaft.B, p * unit * shaft.E
    step = np.eye(len(flow)) + expm1(flow, interval)
    held = np.zeros(size)
    if size > 2:
        held[:-2] = -np.linalg.solve(shaft.A[:-2, :-2], shaft.B[:-2])
    return step[:size, :size].copy(), step[:size, size].copy(), step[:size, size + 1].copy(), held


@lru_cache(maxsize=64)
def _gains(axis: Axis, interval: float, rate: float) -> Array:
    """(2, 2 n + 2) gains of the observer in the gap and in contact: Kalman's, with disturbances of all accelerations.

    In the gap the motor alone has the rate (1/s).
    """
    load, n = axis.load, axis.n
    links = chain(load.masses, load.stiffnesses, load.dampings, axis.transmission.k_d, axis.transmission.c_d)
    inertia = 1.0 / (axis.p**2 * float(axis.shaft().E[-2]))
    gains = np.zeros((2, 2 * n + 2))
    gains[0, :2] = 2.0 * rate * interval, rate * rate * interval
    # Motor's angle and speed, positions and speeds of the load, all at the load.
    flow = np.zeros((2 * n + 2, 2 * n + 2))
    flow[0, 1] = 1.0
    flow[1, :2] = -axis.transmission.k_d / inertia, -axis.transmission.c_d / inertia
    flow[1, 2:] = -links.reaction / inertia
    flow[2:, 2:] = links.A
    flow[2:, 0], flow[2:, 1] = links.B_position, links.B_velocity
    step = np.eye(len(flow)) + expm1(flow, interval)
    noise = np.zeros((2 * n + 2, 2 * n + 2))
    shaken = [1, *range(2 + n, 2 + 2 * n)]
    noise[shaken, shaken] = rate**4 * interval * interval
    gains[1] = _kalman(step, noise)
    return gains


def _kalman(step: Array, noise: Array) -> Array:
    """(s,) stationary gains of a filter that measures the first state with a variance of 1, by doubling the time."""
    size = len(step)
    forwards, backwards, spread = step.T.copy(), np.zeros((size, size)), noise.copy()
    backwards[0, 0] = 1.0
    for _ in range(_DOUBLINGS):
        inner = np.linalg.inv(np.eye(size) + backwards @ spread)
        spread, backwards, forwards = (
            spread + forwards.T @ spread @ inner @ forwards,
            backwards + forwards @ inner @ backwards @ forwards.T,
            forwards @ inner @ forwards,
        )
    return np.asarray(spread[:, 0] / (spread[0, 0] + 1.0))
