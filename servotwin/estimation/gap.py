"""Estimate the gap by any method: one entry, one registry. A new method is one more module in `METHODS`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from servotwin.errors import InvalidInput
from servotwin.estimation import motor_side, output_error, paper, whitened
from servotwin.estimation.axis_model import has_servo, servo_of
from servotwin.estimation.estimate import GapEstimate, no_estimate
from servotwin.estimation.late_window import prompt_window
from servotwin.estimation.motors_position import is_motors_position
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo


class Method(NamedTuple):
    """An estimator in the registry.

    Attributes
    ----------
    estimate : callable
        (window, servo, prior, settings) -> GapEstimate; the prior is a gap (rad), an estimate that is OK, or None.
    settings : type
        Class of its settings.
    shortest : callable
        (settings, servo, sample rate in Hz) -> shortest window (s), and the reason in words.
    """

    estimate: Callable[..., GapEstimate]
    settings: type
    shortest: Callable[[Any, Servo, float], tuple[float, str]]


METHODS: Mapping[str, Method] = {
    module.METHOD: Method(module.estimate, settings, module.shortest_window)
    for module, settings in (
        (whitened, whitened.WhitenedSettings),
        (paper, paper.PaperSettings),
    )
}
"""The methods for a servo, those of a twin."""

_MOTORS_OWN = (
    "axis sensors feedback = \"motor\": position follows the motor's angle as the motor's own does, and as the load's "
    'without a gap would; give the load\'s position, and if this is it, state feedback = "load"'
)
ALLOWED, ROUNDED = 0.6, 0.5  # of a count: largest spread of a coarse encoder that is accepted, its own error
_ALL = {
    **METHODS,
    **{
        module.METHOD: Method(module.estimate, settings, module.shortest_window)
        for module, settings in (
            (output_error, output_error.OutputErrorSettings),
            (motor_side, motor_side.MotorSideSettings),
        )
    },
}


def estimate_gap(
    window: Window,
    servo: Plant,
    method: str | None = None,
    prior: float | GapEstimate | None = None,
    settings: Any = None,
) -> GapEstimate:
    """Estimate the total gap from a window of measurements, with its spread and status.

    Parameters
    ----------
    window : Window
        Readings of late encoders (`Axis.sensors`) are taken as of when they were true.
    servo : Servo or Axis
        The model; its controller does not matter.
    method : str, optional
        "whitened" (`servotwin.estimation.whitened`), the default where the driven end is held in the gap;
        "output_error" (`servotwin.estimation.output_error`), the default for a shaft that is free in the gap and for
        one mass behind a rigid transmission; "motor_side" (`servotwin.estimation.motor_side`), the default where the
        window does not have the load's position; or "paper", the published one (`servotwin.estimation.paper`).
    prior : float or GapEstimate, optional
        Total gap known before, rad; an estimate that is not OK is ignored. The search starts there, among other
        places; "whitened" also returns it where the window does not show the gap.
    settings : optional
        The method's own `Settings`. Without them the largest accepted spread of an axis is at least 0.6 counts of the
        motor's encoder, its shift and model error half a count.

    Raises
    ------
    InvalidInput
        An unknown method, a prior that is not a gap, settings of another method, a window that lacks a channel or
        is too short, a method that is not for this axis.
    """
    window = prompt_window(window, servo)
    method = _method_for(window, servo) if method is None else method
    chosen, known = settings_of(method, settings), _usable_prior(prior)
    if isinstance(servo, Axis) and method != motor_side.METHOD:
        _check_position(window, servo)
    if isinstance(servo, Servo) or method == motor_side.METHOD:
        return _ALL[method].estimate(window, servo, known, chosen)
    if method == output_error.METHOD:
        return _loads_own(output_error.estimate(window, servo, known, chosen), servo)
    chosen = options_for(servo, method, settings)
    estimate: GapEstimate = _ALL[method].estimate(window, servo_of(servo), known, chosen)
    return replace(estimate, model_version=servo.version)


def options_for(servo: Plant, method: str, settings: Any = None) -> Any:
    """Return the settings, or the method's defaults for a plant: an axis's coarse encoder sets limits in counts."""
    chosen = settings_of(method, settings)
    if settings is None and isinstance(servo, Axis) and isinstance(chosen, whitened.WhitenedSettings):
        return _in_counts(chosen, servo.encoder_resolution)
    return chosen


def default_method(servo: Plant) -> str:
    """The method that estimates a servo's or an axis's gap where none is named."""
    return whitened.METHOD if isinstance(servo, Servo) or has_servo(servo) else output_error.METHOD


def _method_for(window: Window, servo: Plant) -> str:
    """The default method for a window: without the load's position the one that reads the motor."""
    if not window.has_position:
        return motor_side.METHOD
    if not is_motors_position(window, servo):
        return default_method(servo)
    if servo.rigid:
        raise InvalidInput(f"{window.where}{_MOTORS_OWN}; behind a rigid transmission the motor shows no gap")
    return motor_side.METHOD


def _loads_own(estimate: GapEstimate, axis: Plant) -> GapEstimate:
    """The estimate; refused without a gap, where a position that the drive computed from the motor shows none."""
    if not (axis.at_motor and axis.rigid and estimate.ok and estimate.interval[0] <= 0.0):
        return estimate
    blank = no_estimate(estimate.time, (_MOTORS_OWN,), estimate.model_version, estimate.method)
    return replace(blank, rms=estimate.rms, evaluations=estimate.evaluations)


def settings_of(method: str, settings: Any = None) -> Any:
    """Return the settings, or the method's defaults where they are None.

    Raises
    ------
    InvalidInput
        An unknown method, settings of another method.
    """
    if method not in _ALL:
        raise InvalidInput(f"method {method!r} does not exist: allowed are {', '.join(_ALL)}")
    kind = _ALL[method].settings
    if settings is not None and not isinstance(settings, kind):
        expected = f"{kind.__module__.removeprefix('servotwin.')}.{kind.__name__}"
        raise InvalidInput(f"settings {settings!r} do not belong to method {method!r}: give {expected}")
    return kind() if settings is None else settings


def shortest_window(method: str, servo: Servo, sample_rate: float, settings: Any = None) -> tuple[float, str]:
    """The shortest window (s) of a servo that a method accepts at a sample rate (Hz), and why, in words."""
    return _ALL[method].shortest(settings_of(method, settings), servo, sample_rate)


def _in_counts(settings: whitened.WhitenedSettings, count: float) -> whitened.WhitenedSettings:
    """The settings with a spread that one count (rad) of a coarse encoder allows, and causes."""
    return replace(
        settings,
        largest_std=max(settings.largest_std, ALLOWED * count),
        largest_shift=max(settings.largest_shift, ROUNDED * count),
        model_error=max(settings.model_error, ROUNDED * count),
    )


def _check_position(window: Window, axis: Axis) -> None:
    """Refuse a window whose position is the motor's own."""
    if is_motors_position(window, axis):
        raise InvalidInput(
            f'{window.where}axis sensors feedback = "motor": position is the motor\'s angle times the ratio, and '
            'the gap lies behind the motor; give the load\'s own position, or method = "motor_side"'
        )


def _usable_prior(prior: float | GapEstimate | None) -> float | GapEstimate | None:
    """Return the prior; None for an estimate that is not OK."""
    if isinstance(prior, GapEstimate):
        return prior if prior.ok else None
    if prior is not None and not (math.isfinite(prior) and prior >= 0.0):
        raise InvalidInput(f"prior = {prior!r} rad: must be a finite total gap of at least 0")
    return prior
