"""Gap of an axis from the motor's encoder and the command alone: the motor feels the load through the shaft.

Motor and load are simulated together under the command, contacts included, and fitted to the motor's angle, with the
numbers of both free within what is known of them. docs/estimator-axes.md explains it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.upsampling import upsampled
from servotwin.estimation.core.visible import counted
from servotwin.estimation.estimate import GapEstimate, GapStatus, interval_95, no_estimate
from servotwin.estimation.motor_side.held_motion import HeldShaft
from servotwin.estimation.motor_side.problem import MotorModel, MotorProblem
from servotwin.estimation.motor_side.search import search
from servotwin.estimation.motor_side.settings import MotorSideSettings
from servotwin.estimation.motor_side.verdict import judge
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.models import Priors, ShaftModel
from servotwin.estimation.output_error.verdict import JudgedFit
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

__all__ = ["METHOD", "MotorSideSettings", "check_reaction", "estimate", "fit", "shortest_window"]

METHOD = "motor_side"
SHORTEST = 400  # samples
_LATE = 0.5  # samples: usual delay of the command
# Of the motor's inertia: least inertia of the load as the motor feels it. Of five accepted windows of the ball screw, a
# tenth, two were wrong by 5 and 28 %; behind a screw that the gap holds one of 20 between 0.03 and a third, by 6 %.
_FELT = 1.0 / 3.0


def shortest_window(_settings: MotorSideSettings, _axis: object, sample_rate: float) -> tuple[float, str]:
    """Shortest window (s) at a sample rate (Hz), and the reason in words."""
    return SHORTEST / sample_rate, f"method {METHOD!r}, which needs {SHORTEST} samples"


def check_reaction(plant: Plant) -> None:
    """Refuse a machine whose motor does not feel the load, or whose friction is not in the model.

    Raises
    ------
    InvalidInput
        A rigid transmission, a servo, a drive that follows its command whatever the load, a load that is light beside
        the motor, or friction that falls with the speed.
    """
    needs = "the motor's encoder and the command do not show the gap"
    if plant.rigid:
        raise InvalidInput(
            f"{needs}: the transmission is rigid, so that in the model no load acts back on the motor, inside and "
            "outside of the gap alike; give the load's position, or state the transmission's stiffness"
        )
    if isinstance(plant, Servo):
        raise InvalidInput(
            f"{needs} of a servo: method {METHOD!r} is for axes; describe the machine as an axis of parts, or give the "
            "load's position"
        )
    if not np.any(plant.shaft().E):
        kind = type(plant.actuator).__name__
        raise InvalidInput(
            f"{needs}: the actuator ({kind}) follows its command whatever the load, and feels no contact; give the "
            "load's position"
        )
    felt = plant.p**2 * float(np.sum(plant.load.masses)) * float(plant.shaft().E[-2])
    if felt < _FELT:
        raise InvalidInput(
            f"{needs}: the load's inertia at the motor is {100.0 * felt:.0f} % of the motor's own, so that friction "
            f"hides its reaction, and at least {100.0 * _FELT:.0f} % are needed; give the load's position"
        )
    if plant.motor_stribeck.slope or plant.guide.stribeck.slope:
        raise InvalidInput(
            f"static_friction: method {METHOD!r} knows no friction that falls with the speed; leave static friction "
            "and Stribeck speed out of the model, or give the load's position"
        )


def estimate(
    window: Window, axis: Plant, prior: float | GapEstimate | None, settings: MotorSideSettings | None
) -> GapEstimate:
    """Estimate the total gap (rad at the motor) from a window with theta_m and the command.

    Parameters
    ----------
    window : Window
        Its channel `voltage` is the command in the actuator's unit; the position is not used.
    axis : Axis
        With an elastic transmission, and an actuator that feels the load.
    prior : float or GapEstimate, optional
        Total gap, rad: one of the starts.
    settings : MotorSideSettings, optional

    Raises
    ------
    InvalidInput
        An axis whose motor does not feel the load, no theta_m, no command, a window too short.
    """
    settings = settings or MotorSideSettings()
    check_reaction(axis)
    assert isinstance(axis, Axis)
    theta_m, _ = _checked(window.driven(axis.command_limit))
    blank = no_estimate(window.mid_time, model_version=axis.version, method=METHOD)
    if float(np.ptp(theta_m)) == 0.0:
        return replace(blank, reasons=("theta_m is constant: nothing moved, or the sensor is dead",))
    if slow := upsampled(theta_m, window.sample_rate):
        return replace(blank, status=GapStatus.MODEL_MISMATCH, reasons=slow)
    unit = 2.0 / axis.p
    found = fit(window, axis, prior, settings)
    verdict = judge(found, settings, unit)
    rms = float(np.sqrt(np.mean(found.best.raw**2)))
    return _stated(replace(blank, rms=rms, evaluations=found.best.evaluations), verdict, unit)


def fit(window: Window, axis: Axis, prior: float | GapEstimate | None, settings: MotorSideSettings) -> Search:
    """Fit a window as `estimate` does; raises InvalidInput as it does."""
    expected = prior.gap if isinstance(prior, GapEstimate) else prior
    return search(problem_of(window, axis, settings), 0.5 * axis.p * (expected or 0.0))


def problem_of(window: Window, axis: Axis, settings: MotorSideSettings) -> MotorProblem:
    """The window with its model; raises InvalidInput as `estimate` does."""
    theta_m, command = _checked(window.driven(axis.command_limit))
    return _problem(window, theta_m, command, axis, settings)


def _checked(window: Window) -> tuple[Array, Array]:
    """The motor's angle and the command of a window that can be fitted."""
    for name, channel, unit in (
        ("theta_m", window.theta_m, "the motor's angle in rad"),
        ("command", window.voltage, 'the drive\'s command in its unit, as the channel "voltage"'),
    ):
        if channel is None:
            raise InvalidInput(f"{window.where}the window has no {name}: method {METHOD!r} needs {unit}")
    assert window.theta_m is not None
    assert window.voltage is not None
    if window.theta_m.size < SHORTEST:
        size = window.theta_m.size
        raise InvalidInput(f"{window.where}the window has {size} samples: method {METHOD!r} needs at least {SHORTEST}")
    return window.theta_m, window.voltage


def _problem(window: Window, theta_m: Array, command: Array, axis: Axis, settings: MotorSideSettings) -> MotorProblem:
    """The window with its model."""
    interval = 1.0 / window.sample_rate
    count = max(axis.encoder_resolution, counted(theta_m))
    priors = Priors(settings.stiffness, settings.damping, settings.mass_ratio, 1.0, interval)
    held = axis.backlash_kind is BacklashKind.HELD
    shaft = HeldShaft(axis, priors, settings.screw) if held else ShaftModel(axis, priors)
    model = MotorModel(axis, shaft, settings.inertia, settings.torque, settings.damping, _LATE * interval)
    return MotorProblem(model, axis.p * theta_m, command, interval, axis.p * count)


def _stated(blank: GapEstimate, verdict: JudgedFit, unit: float) -> GapEstimate:
    """Fill a blank estimate."""
    made = replace(blank, status=verdict.status, reasons=verdict.reasons)
    if verdict.status is not GapStatus.OK:
        return made
    gap, std, total = unit * verdict.half, unit * verdict.std, unit * verdict.std_total
    return replace(made, gap=gap, std=std, std_total=total, interval=interval_95(gap, total))
