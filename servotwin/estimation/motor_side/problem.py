"""Model of a window with the motor's angle and the command only: the motor feels the load through the shaft."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servotwin.estimation.motor_side.drive import MotorDrive, observer_gains, states_at
from servotwin.estimation.motor_side.free_motion import free_motion
from servotwin.estimation.motor_side.held_motion import HeldShaft, held_motion
from servotwin.estimation.output_error.models import (
    HALF,
    Flags,
    ShaftModel,
    Unknown,
    independent,
    usual_sizes,
)
from servotwin.estimation.output_error.problem import LARGEST, delayed
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array

_HALVES = (0.4, 0.28, 0.2, 0.14, 0.1, 0.07, 0.05, 0.035, 0.025, 0.017, 0.012, 0.008, 0.005)  # of the motor's travel
_PLACES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of the half gap
_WIDE = 5.0  # of the motor's travel
_MOVED = 0.02  # of the window: what shows the first speed
_FIXED = ("offset", "delay", "ratio", "position offset")
_MOTOR = (
    *("load inertia", "torque per command", "motor damping", "motor friction"),
    *("input bias", "command's delay", "motor's first speed"),
)


@dataclass(frozen=True)
class MotorModel:
    """The load's model with the motor's: its reaction accelerates the motor.

    Attributes
    ----------
    axis : Axis
    shaft : ShaftModel or HeldShaft
    load, torque, damping, delay : float
        Standard deviations beforehand: of the load's inertia, the torque per command and the motor's friction,
        relative, and of the command's delay, s.
    """

    axis: Axis
    shaft: ShaftModel | HeldShaft
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
        shaft, of_load = self.model.shaft, values[: -len(_MOTOR)]
        gains = observer_gains(self.model.axis, self.interval, rate)
        if isinstance(shaft, HeldShaft):
            return held_motion(shaft, self._drive(values), of_load, gains)
        return free_motion(shaft, self._drive(values), of_load, gains)

    def _drive(self, values: Array) -> MotorDrive:
        """Motor and command for unknowns (u,)."""
        inertia, torque, damping, friction, bias, late, off = values[-len(_MOTOR) :].tolist()
        actuator = self.model.axis.actuator.scaled(math.exp(torque), math.exp(damping))
        command = delayed(self.command, late / self.interval) + bias
        first = states_at(actuator, float(command[0]), self.first_speed() + off, float(self.position[0]))
        rubs = math.exp(friction) * self.model.axis.motor_friction
        return MotorDrive(actuator, math.exp(inertia), rubs, command, first, self.position, self.interval)

    def misfit(self, values: Array, rate: float = 0.0) -> Array:
        """(N,) angle of the motor as predicted by an observer of a rate (1/s) less the measured one, at the load."""
        return np.asarray(self.simulate(values, rate)[0] - self.position)

    def misfits(self, points: list[Array], rate: float = 0.0) -> list[Array]:
        """`misfit` (N,) at several points, on all cores: each is a run of milliseconds without the interpreter."""
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            return list(pool.map(lambda values: self.misfit(values, rate), points))

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
        wide = _WIDE * self.range
        places = [unknown.first and unknown.unit == "load" for unknown in self.model.unknowns]
        tables = []
        for side in (-1.0, 1.0):
            off = [(1.0 + place) * abs(float(values[HALF])) for place in _PLACES]
            tried = [np.where(places, self.start(wide, side * (each / wide - 1.0)), values) for each in off]
            for each in tried:
                each[HALF] = wide
            tables.append(tried)
        return tables
