"""The servo with the numbers that were learnt of it, and the uncertainty that is left of them."""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.learning.motor import BACK_EMF, LAG, LearntMotor
from servotwin.estimation.whitened.free_model import FactorPrior, adapted
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.redesign.certified.rest_in_gap import floats_in_gap
from servotwin.redesign.certified.uncertainty import LearntFactors, Uncertainty

# Standard deviations, relative, of stiffness and damping below which a learnt machine is not believed: what the model
# leaves out does not average away with the windows.
_LEAST_K, _LEAST_C = 0.002, 0.01
# Of a stated half-width: a number of the motor that is not known better than that stays as stated.
_WELL_KNOWN = 0.5


def counts_learnt(servo: Plant, machine: FactorPrior | None, known: Uncertainty) -> bool:
    """True where a learnt machine counts in place of the stated half-widths.

    Of a free shaft its stiffness over the load's mass does, once it is known to half of what is stated. Of its load
    nothing is learnt: one with springs of its own, which the verification draws with the shaft's, does not count, nor
    does one that floats in the gap, whose mass and damping decide how it comes to rest. An elastic screw that is held
    in the gap brings the load's mass to the motor, and neither is learnt.
    """
    if machine is None or servo.backlash_kind is BacklashKind.HELD:
        return False
    if servo.backlash_kind is BacklashKind.RIGID:
        return True
    alone = isinstance(servo, Axis) and len(servo.load.m) == 1 and not any(servo.load.k) and not floats_in_gap(servo)
    return alone and math.sqrt(3.0 * machine.covariance[0, 0]) < _WELL_KNOWN * known.k


def narrowed(known: Uncertainty, learnt: LearntFactors) -> Uncertainty:
    """Prior knowledge with what was learnt in place of the stated half-widths."""
    # Learnt stiffness and damping are those over the masses, which are then taken as the model's, unless the mass acts
    # back on the motor.
    alone = "k" in learnt.names and not learnt.per_mass
    return known.replace(learnt=learnt, m=0.0 if alone else known.m)


def learnt_servo(
    servo: Plant, known: Uncertainty, machine: FactorPrior | None, motor: LearntMotor | None
) -> tuple[Plant, LearntFactors] | None:
    """The servo with its learnt numbers, and what is left open of them; None: nothing was learnt.

    The motor's numbers count where the windows told more of them than was stated.
    """
    names, variances = list[str](), list[Array]()
    shaft = servo.backlash_kind is BacklashKind.FREE
    if machine is not None and counts_learnt(servo, machine, known):
        if shaft:
            servo = servo.scaled({"k": math.exp(machine.mean[0])})
            names.append("k")
            variances.append(machine.covariance[:1, :1] + _LEAST_K**2)
        else:
            servo = adapted(servo, machine.mean) if isinstance(servo, Servo) else _scaled(servo, machine.mean)
            names += ["k", "c", "p"]
            variances.append(machine.covariance[:3, :3] + np.diag([_LEAST_K**2, _LEAST_C**2, 0.0]))
    if motor is not None:
        for name, index, sign, width in (("k_B", BACK_EMF, 1, known.k_B), ("k_T", LAG, -1, known.k_T)):
            relative = motor.std(index) / (1.0 + motor.mean[index])
            if math.sqrt(3.0) * relative < _WELL_KNOWN * width:
                servo = servo.scaled({name: (1.0 + motor.mean[index]) ** sign})
                names.append(name)
                variances.append(np.array([[relative**2]]))
    if not names:
        return None
    # Here, because the import takes longer than the rest of this module and is rarely needed.
    from scipy.linalg import block_diag

    covariance = block_diag(*variances)
    spread = tuple(tuple(row) for row in covariance.tolist())
    return servo, LearntFactors(tuple(names), (0.0,) * len(names), spread, per_mass=shaft)


def _scaled(axis: Axis, factors: Array) -> Axis:
    """The axis with other logarithms of stiffness, damping and ratio; a ratio of masses stays the model's."""
    return axis.scaled(dict(zip(("k", "c", "p"), map(math.exp, factors[:3].tolist()), strict=True)))
