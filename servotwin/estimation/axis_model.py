"""The servo that has an axis's way from the motor's angle to the load: what the paper's estimators need of an axis."""

from __future__ import annotations

from functools import lru_cache

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import DcMotor
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.load import LINEAR
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo

_LEAST_MASSES = 2


def has_servo(axis: Axis) -> bool:
    """True where a `Servo` can stand for the axis.

    Its driven end is held in the gap and drives two masses or more, without Coulomb friction; behind an elastic
    transmission the load hangs on the ground.
    """
    held = axis.backlash_kind is not BacklashKind.FREE
    anchored = axis.rigid or axis.load.k[0] > 0.0
    return held and anchored and axis.n >= _LEAST_MASSES and not axis.load.friction


def servo_for(plant: Plant) -> Servo | None:
    """The servo that stands for a plant: itself, the one of an axis, or None where there is none."""
    if isinstance(plant, Servo):
        return plant
    return servo_of(plant) if has_servo(plant) else None


@lru_cache(maxsize=32)
def servo_of(axis: Axis) -> Servo:
    """The servo with the axis's transmission, load, encoders and controller.

    The estimators read the angle. Of the motor they use the loop's own time alone, through its back EMF: that of
    another actuator than a DC motor stands for the crossover of the loop.

    Raises
    ------
    InvalidInput
        No servo stands for the axis.
    """
    if not has_servo(axis):
        raise InvalidInput(
            f'{_without_servo(axis)}: methods "whitened" and "paper" need a transmission that is held in the gap, at '
            'least 2 masses and no Coulomb friction of the load; leave the method out, or give method = "output_error"'
        )
    load, motor = axis.load, axis.actuator
    # With a rigid transmission the first spring is inert: a free load may have any.
    springs = (load.k[0] or load.k[1], *load.k[1:]) if axis.rigid else load.k
    J, R, k_T, k_B, L = 1.0, 1.0, 1.0, _loop_gain(axis), 1.0
    if isinstance(motor, DcMotor):
        J, R, k_T, k_B, L = motor.J, motor.R, motor.k_T, motor.k_B, motor.L or 1.0
    return Servo(
        m=load.m, k=springs, c=load.c, J=J, p=axis.p, L=L, R=R, k_T=k_T, k_B=k_B, n=load.n,
        controller=_filtered_pid(axis),
        k_d=axis.transmission.k_d, encoder_resolution=axis.encoder_resolution,
        position_resolution=axis.sensors.position_resolution,
    )  # fmt: skip


def _without_servo(axis: Axis) -> str:
    """Words for what makes an axis one that no servo stands for."""
    load = axis.load
    if axis.backlash_kind is BacklashKind.FREE:
        return "axis with a shaft that is free in the gap"
    if load.friction:
        unit = "N" if load.motion == LINEAR else "N m"
        return f"load {load.key('friction')} = {load.friction!r} {unit}"
    return "axis with one mass" if axis.n < _LEAST_MASSES else "load k[0] = 0.0 behind an elastic transmission"


def _loop_gain(axis: Axis) -> float:
    """Back EMF (V s/rad) with which a servo's loop is as fast as the axis's: Kp p over the crossover."""
    crossovers = axis.margins().gain_crossovers
    crossover = crossovers[0].omega if crossovers else 1.0
    return abs(_filtered_pid(axis).Kp) * axis.p / crossover or 1.0


def _filtered_pid(axis: Axis) -> Controller:
    """The axis's controller; for a linear law a proportional one, whose gain the loop gain makes as fast."""
    law = axis.controller
    return law if isinstance(law, Controller) else Controller(1.0 / axis.p, 0.0, 0.0, 1.0)
