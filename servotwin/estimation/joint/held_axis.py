"""The joint estimate of an axis that a servo stands for: channels, limits in counts, the axis with fitted numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.axis_model import has_servo
from servotwin.estimation.gap import ALLOWED, ROUNDED, is_motors_position
from servotwin.estimation.joint.settings import JointSettings
from servotwin.estimation.joint.verdict import JointEstimate
from servotwin.estimation.window import Window
from servotwin.plant.actuator import Actuator, DcMotor
from servotwin.plant.axis import Axis


def check_channels(window: Window, axis: Axis) -> None:
    """Refuse a window without the load's position, or without an angle that cannot be computed.

    Raises
    ------
    InvalidInput
    """
    if not window.has_position or is_motors_position(window, axis):
        whose = "no position" if not window.has_position else "the motor's own position, and no other"
        raise InvalidInput(
            f"{window.where}the window has {whose}: the joint estimator needs the load's; from the motor's side "
            "estimate_gap frees the model's numbers as far as they show there"
        )
    if window.theta_m is None and has_servo(axis) and axis.rigid and not _is_servos(axis.actuator):
        raise InvalidInput(
            f"{window.where}the window has no theta_m (rad): from the command the joint estimator computes the angle "
            "of a DC motor with inductance and without friction only"
        )


def _is_servos(actuator: Actuator) -> bool:
    """True where a motor is the one of the paper's servo."""
    return isinstance(actuator, DcMotor) and actuator.L > 0.0 and not (actuator.friction or actuator.coulomb)


def in_counts(windows: Sequence[Window], axis: Axis) -> JointSettings:
    """Default settings with the spread that one count of a coarse encoder allows, and gaps as wide as the motor goes.

    Gaps of a fine axis may be hundreds of degrees of its motor.
    """
    usual, count = JointSettings(), axis.encoder_resolution
    way = max((float(np.ptp(window.theta_m)) for window in windows if window.theta_m is not None), default=0.0)
    return replace(
        usual,
        largest_std_rad=max(usual.largest_std_rad, ALLOWED * count),
        model_error_rad=max(usual.model_error_rad, ROUNDED * count),
        largest_gap_rad=max(usual.largest_gap_rad, way),
    )


def of_servos_axis(found: JointEstimate, axis: Axis) -> JointEstimate:
    """An estimate of the servo that stands for an axis, as one of the axis."""
    factors = {name: one.factor for name, one in found.parameters.items() if not math.isnan(one.factor)}
    plain = {"k/m": "k", "c/m": "c", "pitch": "p", "k_B": "k_B"}
    made = axis.scaled({plain[name]: factor for name, factor in factors.items() if name in plain})
    screw = replace(made.transmission, k_d=factors.get("k_d", 1.0) * axis.transmission.k_d)
    return replace(
        found,
        gaps=tuple(replace(gap, model_version=axis.version) for gap in found.gaps),
        servo=made.replace(transmission=screw),
    )
