"""The joint estimate of an axis that a servo stands for: channels, limits in counts, the axis with fitted numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.axis_model import has_servo
from servotwin.estimation.gap import ALLOWED, ROUNDED
from servotwin.estimation.joint.settings import JointSettings
from servotwin.estimation.joint.verdict import JointEstimate, Parameter
from servotwin.estimation.motors_position import is_motors_position
from servotwin.estimation.window import Window
from servotwin.plant.actuator import Actuator, DcMotor
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array

# Standard deviations, of logarithms, of what counts leave beyond the draws of their rounding (delay: samples).
_IN_COUNTS = {"k/m": 2e-3, "c/m": 2e-2, "pitch": 3e-5}
_LATE = 0.02
# Several stiffnesses of a stiff screw explain its first mass's ringing alike; the fit finds one of them.
_STIFF_SCREW = 0.2


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


def of_servos_axis(found: JointEstimate, axis: Axis, sample_rate: float) -> JointEstimate:
    """An estimate of the servo that stands for an axis, as one of the axis that was sampled at a rate (Hz)."""
    factors = {name: one.factor for name, one in found.parameters.items() if not math.isnan(one.factor)}
    plain = {"k/m": "k", "c/m": "c", "pitch": "p", "k_B": "k_B"}
    made = axis.scaled({plain[name]: factor for name, factor in factors.items() if name in plain})
    screw = replace(made.transmission, k_d=factors.get("k_d", 1.0) * axis.transmission.k_d)
    covariance = found.covariance + _of_stiff_screw(found)
    if axis.encoder_resolution or axis.sensors.position_resolution:
        left_out = {**_IN_COUNTS, "delay": _LATE / sample_rate}
        covariance += np.diag([left_out.get(name, 0.0) ** 2 for name in found.names])
    stds = dict(zip(found.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    return replace(
        found,
        gaps=tuple(replace(gap, model_version=axis.version) for gap in found.gaps),
        parameters={name: _with_std(one, stds[name]) for name, one in found.parameters.items()},
        covariance=covariance,
        servo=made.replace(transmission=screw),
    )


def _of_stiff_screw(found: JointEstimate) -> Array:
    """(P, P) covariance by a screw's stiffness that may be another: where it moves the others follow."""
    total = np.zeros_like(found.covariance)
    place = found.names.index("k_d") if "k_d" in found.names else -1
    if place < 0 or not 0.0 < found.covariance[place, place] < math.inf:
        return total
    moved = _STIFF_SCREW * found.covariance[place] / found.covariance[place, place]
    return total + np.outer(moved, moved)


def _with_std(one: Parameter, std: float) -> Parameter:
    """A parameter with another standard deviation, of its logarithm where it has a factor."""
    return replace(one, std=std if math.isnan(one.factor) else abs(one.value) * std)
