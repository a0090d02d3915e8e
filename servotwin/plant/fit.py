"""Parts of an axis that do not fit each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController
from servotwin.control.linear_law import LinearLaw
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import Actuator, DcMotor, Stepper, TorqueDrive, VelocityDrive, static_torque
from servotwin.plant.basis import BacklashKind
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.structure import Chain
from servotwin.plant.transmission import Transmission

PARTS: Mapping[str, tuple[type, ...]] = {
    "actuator": (DcMotor, TorqueDrive, VelocityDrive, Stepper),
    "transmission": (Transmission,),
    "load": (Load,),
    "controller": (Controller, Cascade, LinearLaw),
    "sensors": (Sensors,),
}
"""Classes of each part of an axis."""
_LIMITS = {"V": "voltage_limit_v", "N m": "torque_limit_n_m"}
# A cascade may be told a ratio that is off by less.
_OTHER_RATIO = 0.2


def check_kinds(parts: Mapping[str, object]) -> None:
    """Refuse parts of another class.

    Raises
    ------
    InvalidInput
        One is.
    """
    for name, part in parts.items():
        if not isinstance(part, PARTS[name]):
            names = " or ".join(kind.__name__ for kind in PARTS[name])
            raise InvalidInput(f"axis {name} = {part!r}: must be a {names}")


def check_damped(load: Load, chain: Chain) -> None:
    """Refuse a load behind a rigid transmission that swings for ever, which the motor's encoder does not see.

    Raises
    ------
    InvalidInput
        It does.
    """
    if load.n > 1 and not np.linalg.eigvals(chain.A).real.max() < 0.0:
        raise InvalidInput(
            f"load {load.described('c')} = {load.c!r}: without damping the load swings for ever, and the motor's "
            "encoder does not see it"
        )


def check_fit(actuator: Actuator, transmission: Transmission, load: Load, controller: AnyController) -> None:
    """Refuse parts that do not make an axis together.

    Raises
    ------
    InvalidInput
        A cascade that commands something else than the actuator takes, or has another ratio than the transmission; a
        load that never rests, or with forces that act on nothing.
    """
    if isinstance(controller, Cascade):
        _check_cascade(controller, actuator, transmission.p)
    follows = load.n == 1 and transmission.rigid
    if load.free and not follows and not (any(load.c) or load.friction or transmission.c_d):
        raise InvalidInput(
            f"load {load.described('c')} = {load.c!r}: a free load without damping and friction never rests; "
            "give the damping or friction of its guide, or the damping of the transmission"
        )
    if follows and (load.friction or load.force):
        raise InvalidInput(
            "axis load friction and force: one mass behind a rigid transmission does not act back, so they act on "
            "nothing; give a finite stiffness, or the friction at the motor"
        )
    _check_holding(actuator, transmission, load)


def _check_holding(actuator: Actuator, transmission: Transmission, load: Load) -> None:
    """Refuse a drive whose limit cannot hold the load."""
    if actuator.limit is None or transmission.backlash_kind is not BacklashKind.FREE:
        return
    if not static_torque(actuator):
        return
    most = actuator.limit * static_torque(actuator)
    held = most + actuator.coulomb + transmission.p * load.friction
    if transmission.p * abs(load.force) > held:
        raise InvalidInput(
            f"actuator {_LIMITS[actuator.unit]} = {actuator.limit!r} {actuator.unit}: gives {most:.6g} N m, and "
            f"the load's force takes {transmission.p * abs(load.force):.6g} N m of the motor; "
            "the drive must be able to hold its load"
        )


def _check_cascade(cascade: Cascade, actuator: Actuator, p: float) -> None:
    if isinstance(actuator, Stepper):
        raise InvalidInput("controller: a stepper goes to its commanded angle; a cascade commands a speed or a torque")
    closed = isinstance(actuator, VelocityDrive)
    if closed != (cascade.velocity_gain is None):
        wanted = "must be absent: the drive closes the velocity loop" if closed else "is missing"
        raise InvalidInput(f"controller velocity_gain = {cascade.velocity_gain!r}: {wanted}")
    if not abs(cascade.ratio / p - 1.0) < _OTHER_RATIO:
        raise InvalidInput(
            f"controller ratio = {cascade.ratio!r}: the transmission's travel per angle is {p!r}; leave it out"
        )
