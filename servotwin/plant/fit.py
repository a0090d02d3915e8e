"""Parts of an axis that do not fit each other."""

from __future__ import annotations

from servotwin.control.cascade import Cascade
from servotwin.control.laws import AnyController
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import Actuator, Stepper, VelocityDrive
from servotwin.plant.load import Load
from servotwin.plant.transmission import Transmission

# A cascade may be told a ratio that is off by less.
_OTHER_RATIO = 0.2


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
            f"load c = {load.c!r}: a free load without damping and friction never rests; give the damping or "
            "friction of its guide, or the damping of the transmission"
        )
    if follows and (load.friction or load.force):
        raise InvalidInput(
            "axis load friction and force: one mass behind a rigid transmission does not act back, so they act on "
            "nothing; give a finite stiffness, or the friction at the motor"
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
