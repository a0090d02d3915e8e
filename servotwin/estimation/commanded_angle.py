"""Angle of a motor without an encoder, from its command: of a drive that follows its command whatever the load.

A stepper's shaft goes to the commanded angle, and that of a drive in velocity mode has the commanded speed, each with
the lag of its own model. What the motor did before the window fades within some of these times, which are left out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servotwin.config.units import COMMAND_COLUMNS
from servotwin.control.laws import law_of
from servotwin.errors import InvalidInput
from servotwin.estimation.window import Window
from servotwin.hybrid.exponential import expm1
from servotwin.plant.actuator import Stepper, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array

_FORGOTTEN = 1e-5  # share of what the motor did before the window that is left of it
_SAME = 1e-6  # of a rate: rounding
_JUMP = 10.0  # times the usual step of the reference


def has_commanded_angle(plant: Plant) -> bool:
    """True for a drive that follows its command whatever the load, and whose motor has no encoder."""
    return (
        isinstance(plant, Axis)
        and not plant.sensors.motor_encoder
        and isinstance(plant.actuator, (Stepper, VelocityDrive))
    )


def begins_anew(plant: Plant) -> bool:
    """True where no window tells the angle's zero from that of another: the angle is the integral of a speed."""
    return has_commanded_angle(plant) and isinstance(plant, Axis) and isinstance(plant.actuator, VelocityDrive)


def check_motor_angle(plant: Plant) -> None:
    """Refuse a machine whose motor's angle is neither measured nor follows from its command.

    Raises
    ------
    InvalidInput
        It is such a machine.
    """
    if plant.sensors.motor_encoder or has_commanded_angle(plant):
        return
    assert isinstance(plant, Axis)
    raise InvalidInput(
        f"sensors motor_encoder = false: an estimate of the gap needs the motor's angle, which does not follow from a "
        f'command in {plant.actuator.unit}; give an encoder of the motor, or an actuator of kind "stepper" or '
        '"velocity"'
    )


def with_commanded_angle(window: Window, plant: Plant) -> Window:
    """The window with the motor's angle (rad); computed from its command where the motor has no encoder.

    It then begins later, by the time in which the drive forgets what it did before. The angle of a drive in velocity
    mode begins with that of the load: where it was before, nothing says.

    Raises
    ------
    InvalidInput
        The angle does not follow from the command; the window has an angle, which nothing measured, or no command.
    """
    if plant.sensors.motor_encoder:
        return window
    check_motor_angle(plant)
    assert isinstance(plant, Axis)
    if window.theta_m is not None:
        raise InvalidInput(
            f"{window.where}sensors motor_encoder = false: the window has theta_m, which no encoder gives; leave it "
            "out, or give motor_encoder = true"
        )
    if window.voltage is None:
        raise InvalidInput(
            f"{window.where}the window has no command: sensors motor_encoder = false needs it in {plant.actuator.unit} "
            f"(in a log, the column {COMMAND_COLUMNS[plant.actuator.unit]}), for the motor's angle follows from it"
        )
    command = window.driven(plant.command_limit).voltage
    assert command is not None
    angle, first = _angle(plant, window, command), samples_fading(plant, window.sample_rate)
    kept = {name: values[first:] for name, values in window.channels.items()}
    if window.samples - first < 1:
        raise InvalidInput(
            f"{window.where}the window lasts {window.duration:.6g} s: must be longer than "
            f"{first / window.sample_rate:.6g} s, in which the drive forgets what it did before"
        )
    angle = angle[first:]
    if isinstance(plant.actuator, VelocityDrive):
        angle = angle + (window.position[first] / plant.p - angle[0])
    start = window.start + first / window.sample_rate
    return Window(**kept, theta_m=angle, sample_rate=window.sample_rate, start=start, source=window.source)


def samples_fading(axis: Plant, rate: float) -> int:
    """Samples at a rate (Hz) in which what a drive did before them fades, of an axis that `has_commanded_angle`."""
    assert isinstance(axis, Axis)
    if isinstance(axis.actuator, VelocityDrive):
        return math.ceil(rate * axis.actuator.lag * -math.log(_FORGOTTEN))
    assert isinstance(axis.actuator, Stepper)
    times = -math.log(_FORGOTTEN)
    # (1 + t) exp(-t), of a double pole.
    for _ in range(8):
        times = -math.log(_FORGOTTEN) + math.log1p(times)
    return math.ceil(rate * axis.actuator.smoothing * times)


def _angle(axis: Axis, window: Window, command: Array) -> Array:
    """(n,) angle of a drive (rad) under its command (n,), from rest."""
    step, constant, ramp = _transition(axis, 1.0 / window.sample_rate)
    state = np.array([command[0], 0.0] if isinstance(axis.actuator, VelocityDrive) else [0.0, command[0]])
    change = np.where(_held(axis, window), 0.0, np.diff(command))
    driven = np.outer(command[:-1], constant) + np.outer(change, ramp)
    angle = np.empty(command.size)
    angle[0] = state[1]
    for k, forced in enumerate(driven, 1):
        state = step @ state + forced
        angle[k] = state[1]
    return angle


def _held(axis: Axis, window: Window) -> NDArray[np.bool_]:
    """(n - 1,) true where a command is held to the next sample; else it goes there in a straight line.

    A law that is no faster than the samples holds it. That of any other jumps where the reference does, at the sample
    that shows it.
    """
    law = law_of(axis.controller).sample_rate
    if law is not None and law <= window.sample_rate * (1.0 + _SAME):
        return np.ones(window.samples - 1, dtype=bool)
    if window.reference is None:
        return np.zeros(window.samples - 1, dtype=bool)
    steps = np.abs(np.diff(window.reference))
    return np.asarray(steps > _JUMP * np.median(steps))


def _transition(axis: Axis, interval: float) -> tuple[Array, Array, Array]:
    """Matrix (2, 2) of a sample (s), and what a constant command and its change within the sample add (2,)."""
    shaft = axis.actuator.matrices()
    flow = np.zeros((4, 4))
    flow[:2, :2], flow[:2, 2], flow[2, 3] = shaft.A, shaft.B, 1.0 / interval
    whole = np.eye(4) + expm1(flow, interval)
    return whole[:2, :2], whole[:2, 2], whole[:2, 3]
