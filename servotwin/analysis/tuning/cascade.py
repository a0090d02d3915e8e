"""Tuning of a cascade from inside outwards: velocity loop to a crossover and a phase margin, then the position loop."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

from servotwin.control.cascade import Cascade
from servotwin.control.linear_law import LOAD
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.law_loop import law_response
from servotwin.plant.margins import Margins

# Crossover of the velocity loop over that of the position loop, where none is given: the usual four to ten.
_APART = 5.0
# Time constant of the filter of the speed times the crossover of the velocity loop, where a cascade is made.
_FILTER = 0.1


@dataclass(frozen=True)
class CascadeTuning:
    """A tuned cascade.

    Attributes
    ----------
    controller : Cascade
        The own one with other position_gain, velocity_gain and integral_time.
    position_crossover, position_margin : float
        rad/s and rad: gain crossover of the position loop, cut at the error of the position, and its phase margin.
    margins : Margins
        Of the whole loop, cut at the command, at the controller's own rate.
    """

    controller: Cascade
    position_crossover: float
    position_margin: float
    margins: Margins


def tune_cascade(
    axis: Axis,
    crossover: float,
    phase_margin: float,
    *,
    position_crossover: float | None = None,
    integral: bool = True,
    delay: float = 0.0,
) -> CascadeTuning:
    """Find the gains of an axis's cascade, for the axis without a gap.

    Parameters
    ----------
    axis : Axis
        Its cascade gives filters, notch, feedforwards, limits and rate of the result.
    crossover : float
        rad/s, of the velocity loop (abs = 1); of the position loop where the drive closes the velocity loop.
    phase_margin : float
        rad, of that loop there; without integral action the least.
    position_crossover : float, optional
        rad/s, of the position loop; a fifth of `crossover` by default.
    integral : bool
        False: no integral action.
    delay : float
        s, in series with the plant, beside those of its encoders: that of a sampled law, for one.

    Raises
    ------
    InvalidInput
        The controller is no cascade, a value is out of its range, the margin cannot be reached at this crossover, or
        the whole loop is unstable.
    """
    own = axis.controller
    if not isinstance(own, Cascade):
        raise InvalidInput(f"controller = {own!r}: must be a cascade to be tuned as one")
    if own.velocity_gain is None:
        _check(crossover, crossover, phase_margin, delay)
        tuned = _position_loop(axis, own, crossover, delay)
        if tuned.position_margin < phase_margin:
            raise InvalidInput(
                f"phase margin = {math.degrees(phase_margin):g} deg: the position loop has "
                f"{math.degrees(tuned.position_margin):.3g} deg at {crossover:g} rad/s; lower one of them"
            )
        return tuned
    outer = crossover / _APART if position_crossover is None else position_crossover
    _check(crossover, outer, phase_margin, delay)
    return _position_loop(axis, _velocity_loop(axis, own, crossover, phase_margin, integral, delay), outer, delay)


def under_cascade(axis: Axis, crossover: float) -> Axis:
    """The axis with a cascade, still without gains, in place of its filtered PID: with the same rate and limits.

    Parameters
    ----------
    axis : Axis
        With an encoder at the motor.
    crossover : float
        rad/s, of the velocity loop; the filter of the speed is ten times as fast.

    Raises
    ------
    InvalidInput
        The controller is no filtered PID, the motor has no encoder, or the crossover is not positive and finite.
    """
    own = axis.pidf
    _check(crossover, crossover, math.pi / 2.0, 0.0)
    closed = isinstance(axis.actuator, VelocityDrive)
    cascade = Cascade(
        position_gain=0.0,
        ratio=axis.p,
        velocity_gain=None if closed else 1.0,
        speed_filter=_FILTER / crossover,
        voltage_limit=own.voltage_limit,
        rate_limit=own.rate_limit,
        sample_rate=own.sample_rate,
    )
    return axis.replace(controller=cascade)


def _position_loop(axis: Axis, law: Cascade, crossover: float, delay: float) -> CascadeTuning:
    """The cascade with the position gain for a crossover, where the loop is stable."""
    forward = _position_response(axis, law, crossover, delay)
    law = law.replace(position_gain=1.0 / abs(forward))
    axis.check_loop(law)
    running = law.linear()
    whole = axis.margins(running if running.sample_rate is None else running.held())
    # The angle of -L.
    return CascadeTuning(law, crossover, cmath.phase(-forward), whole)


def _check(crossover: float, outer: float, phase_margin: float, delay: float) -> None:
    for name, value in (("crossover", crossover), ("position_crossover", outer)):
        if not (math.isfinite(value) and value > 0.0):
            raise InvalidInput(f"{name} = {value!r} rad/s: must be positive and finite")
    if not 0.0 < phase_margin < math.pi:
        raise InvalidInput(f"phase margin = {math.degrees(phase_margin):g} deg: must be above 0 and below 180 deg")
    if not (math.isfinite(delay) and delay >= 0.0):
        raise InvalidInput(f"delay = {delay!r} s: must be finite and at least 0")


def _responses(axis: Axis, law: Cascade, omega: float, delay: float) -> tuple[complex, complex, complex, complex]:
    """Command by reference and by y_motor of a continuous law without feedforwards; motor and load by the command."""
    bare = law.replace(sample_rate=None, rate_limit=None, on=LOAD)
    bare = bare.replace(velocity_feedforward=0.0, acceleration_feedforward=0.0)
    reference, motor, _ = law_response(bare.linear(), omega)
    angle, position = (
        complex(plant.response(omega)) * cmath.exp(-1j * omega * (delay + encoder.delay))
        for plant, encoder in zip(axis.plants(), (axis.sensors.motor, axis.sensors.load), strict=True)
    )
    return complex(reference), complex(motor), angle, position


def _velocity_loop(
    axis: Axis, own: Cascade, crossover: float, phase_margin: float, integral: bool, delay: float
) -> Cascade:
    """The cascade with velocity gain and integral time for a crossover and a phase margin."""
    bare = own.replace(velocity_gain=1.0, integral_time=None, position_gain=0.0)
    _, by_motor, angle, _ = _responses(axis, bare, crossover, delay)
    loop = -by_motor * angle
    # What a PI must turn the loop by: between -90 degrees, all integral, and 0.
    turn = phase_margin - cmath.phase(-loop)
    if turn > 0.0 or (integral and turn <= -0.5 * math.pi):
        most, least = (math.degrees(cmath.phase(-loop) - by) for by in (0.0, 0.5 * math.pi))
        raise InvalidInput(
            f"phase margin = {math.degrees(phase_margin):g} deg: a PI velocity loop reaches {max(least, 0.0):.3g} to "
            f"{most:.3g} deg at {crossover:g} rad/s; change the margin or the crossover"
        )
    if not integral:
        return own.replace(velocity_gain=1.0 / abs(loop), integral_time=None)
    time = math.tan(turn + 0.5 * math.pi) / crossover
    return own.replace(velocity_gain=1.0 / abs(loop * (1.0 + 1.0 / (1j * crossover * time))), integral_time=time)


def _position_response(axis: Axis, law: Cascade, omega: float, delay: float) -> complex:
    """Position loop per position gain, its velocity loop closed."""
    by_reference, by_motor, angle, position = _responses(axis, law.replace(position_gain=1.0), omega, delay)
    measured = position if law.on == LOAD else law.ratio * angle
    return by_reference * measured / (1.0 - by_motor * angle)
