"""The paper's estimator (section 4.1, Eqs 22-23, Appendix): observer, play operator and unconstrained BFGS.

It is kept as published, its bias included: what the observer has not yet forgotten at k_s pulls the gap (erratum E8).
Added are a spread, and a refusal where the window cannot show the gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import (
    NORMAL_95,
    NOTHING_KNOWN,
    GapEstimate,
    GapStatus,
    Interval,
    interval_95,
    no_estimate,
)
from servotwin.estimation.paper.bfgs import Minimum, minimise
from servotwin.estimation.paper.observer import observer
from servotwin.estimation.paper.residual import PlayResidual, standard_deviation
from servotwin.estimation.paper.settings import PaperSettings
from servotwin.estimation.paper.zero_phase import ZeroPhase
from servotwin.estimation.window import MINIMUM_SAMPLES, Window
from servotwin.plant.scales import scales
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

__all__ = ["METHOD", "PaperSettings", "estimate", "shortest_window"]

_SPAN_S = (
    0.02  # s of the servo's own: speeds are taken over this time: one encoder count between two samples is no motion
)


@dataclass(frozen=True)
class MotorMotion:
    """Share of the window in which the motor moved (0..1), and how often it changed direction."""

    moving: float
    reversals: int


def motion(theta_m: Array, sample_rate: float, rest_speed: float, second: float = 1.0) -> MotorMotion:
    """Motion of an angle theta_m (n,) rad; slower than `rest_speed` (rad/s) is rest; `second` is the servo's, s."""
    span = min(max(1, round(_SPAN_S * sample_rate * second)), theta_m.size - 1)
    speed = (theta_m[span:] - theta_m[:-span]) * (sample_rate / span)
    direction = np.sign(speed[np.abs(speed) > rest_speed])
    return MotorMotion(direction.size / speed.size, int(np.count_nonzero(np.diff(direction))))


class PaperVerdict(NamedTuple):
    """Status, total gap (rad; NaN when nothing is known) and the reasons for both."""

    status: GapStatus
    gap: float
    reasons: tuple[str, ...]

    def interval(self, std: float) -> Interval:
        """95 % interval of the gap for a standard deviation, rad."""
        if self.status is GapStatus.OK:
            return interval_95(self.gap, std)
        if self.status is GapStatus.LOWER_BOUND:
            return interval_95(self.gap, std)[0], math.inf
        return NOTHING_KNOWN


def judge(residual: PlayResidual, minimum: Minimum, std: float, settings: PaperSettings) -> PaperVerdict:
    """The verdict on a minimum with the statistical standard deviation `std` (rad)."""
    objection = _objection(residual, minimum, std, settings)
    if objection is not None:
        return objection
    fitted, total = float(minimum.point[0]) * residual.scale, math.hypot(std, settings.method_error)
    widest = max(0.0, fitted) + NORMAL_95 * total
    if residual.scale < widest:
        moved = f"the motor moved by {math.degrees(residual.scale):.3g} deg"
        return _unknown(f"{moved}, less than the {math.degrees(widest):.3g} deg that the gap may have")
    verdict = _by_contacts(residual, minimum, max(0.0, fitted), settings.contact_travel)
    return _negative(fitted, total) if fitted < 0.0 and verdict.status is GapStatus.OK else verdict


def _objection(residual: PlayResidual, minimum: Minimum, std: float, settings: PaperSettings) -> PaperVerdict | None:
    """Verdict where the minimum does not show the gap; None where it may."""
    if not minimum.converged:
        return _unknown(f"the minimisation did not converge: {minimum.message}")
    share = residual.unexplained(minimum.cost)
    if share > settings.unexplained:
        reason = f"the model leaves {100.0 * share:.0f} % of the measured motion unexplained"
        return PaperVerdict(GapStatus.MODEL_MISMATCH, math.nan, (reason,))
    if math.isinf(std):
        return _unknown("the measurements do not depend on the gap")
    if std > settings.largest_std:
        allowed = math.degrees(settings.largest_std)
        return _unknown(f"the gap is known to {math.degrees(std):.3g} deg only, and {allowed:.3g} deg are allowed")
    return None


def _negative(fitted: float, std: float) -> PaperVerdict:
    """Verdict on a negative gap: zero when that lies within the spread, otherwise a sign that the model is wrong."""
    reason = f"the best fit has a negative gap of {math.degrees(fitted):.3g} deg"
    if -fitted <= NORMAL_95 * std:
        return PaperVerdict(GapStatus.OK, 0.0, (f"{reason}, taken as 0",))
    return PaperVerdict(GapStatus.MODEL_MISMATCH, math.nan, (reason,))


def _by_contacts(residual: PlayResidual, minimum: Minimum, fitted: float, needed: float) -> PaperVerdict:
    """Decide by contacts: a screw pushed both ways shows the gap, one pushed one way only the motor's free travel."""
    forwards, backwards, free = residual.screw_motion(minimum.point)
    if min(forwards, backwards) >= needed:
        return PaperVerdict(GapStatus.OK, fitted, ())
    pushed = f"{math.degrees(forwards):.3g} deg forwards and {math.degrees(backwards):.3g} deg backwards"
    reason = f"the screw was pushed {pushed}, and {math.degrees(needed):.3g} deg are needed both ways"
    if max(forwards, backwards) >= needed:
        return PaperVerdict(GapStatus.LOWER_BOUND, free, (reason,))
    return _unknown(reason)


def _unknown(reason: str) -> PaperVerdict:
    return PaperVerdict(GapStatus.UNIDENTIFIABLE, math.nan, (reason,))


METHOD = "paper"
_GRADIENT_TOLERANCE, _STEP_TOLERANCE = 1e-8, 1e-9  # of the motor's range: 1e-5 deg in the paper's loop


def shortest_window(settings: PaperSettings, servo: Servo, sample_rate: float) -> tuple[float, str]:
    """Shortest window (s) at a sample rate (Hz), and the reason in words."""
    settle = settings.times(scales(servo).time).settle
    return settle + MINIMUM_SAMPLES / sample_rate, f"the observer, which takes {settle!r} s to settle"


def estimate(
    window: Window, servo: Servo, prior: float | GapEstimate | None, settings: PaperSettings | None
) -> GapEstimate:
    """Estimate the total gap (rad) from a window with theta_m and position.

    Parameters
    ----------
    window : Window
    servo : Servo
        The model, taken as exact.
    prior : float or GapEstimate, optional
        The previous total gap, rad, from which the search starts; None: 0, the paper's first.
    settings : PaperSettings, optional

    Raises
    ------
    InvalidInput
        No theta_m, a window too short for the observer to settle, a low-pass above half the sample rate.
    """
    settings = settings or PaperSettings()
    second = scales(servo).time
    times = settings.times(second)
    theta_m, position = _channels(window, servo, settings)
    refusal = _unmoved(theta_m, window.sample_rate, settings, second)
    if refusal:
        return _nothing(window, servo, refusal)
    model = observer(servo, times.alpha)
    origin = float(position[0]) if settings.origin == "first" else 0.0
    angle_origin = origin / model.static_gain
    skip = math.ceil(times.settle * window.sample_rate - 1e-9)
    theta_m = theta_m - angle_origin
    residual = PlayResidual.of(theta_m, position - origin, window.sample_rate, model, servo.p, skip)
    previous = prior.gap if isinstance(prior, GapEstimate) else prior
    start = _start(theta_m, previous or 0.0) / residual.scale
    minimum = minimise(residual.slope, start, _GRADIENT_TOLERANCE, _STEP_TOLERANCE, settings.iterations)
    return _stated(_nothing(window, servo), settings, residual, minimum, angle_origin)


def _channels(window: Window, servo: Servo, settings: PaperSettings) -> tuple[Array, Array]:
    """theta_m and position, low-passed where the settings say so."""
    if window.theta_m is None:
        raise InvalidInput(f"{window.where}the window has no theta_m: method 'paper' needs the motor's angle in rad")
    needed, _ = shortest_window(settings, servo, window.sample_rate)
    if window.duration < needed * (1.0 - 1e-9):
        raise InvalidInput(
            f"{window.where}the window lasts {window.duration:.6g} s: must be at least {needed:.6g} s, so that the "
            f"observer can settle for settle_s = {settings.times(scales(servo).time).settle:.6g} s"
        )
    cutoff, rate = settings.lowpass_hz, window.sample_rate
    if cutoff is None:
        return window.theta_m, window.position
    if cutoff >= 0.5 * rate:
        raise InvalidInput(f"estimator lowpass_hz = {cutoff!r} Hz: must be below half the sample rate of {rate:.6g} Hz")
    order = settings.lowpass_order
    samples = 3 * order if settings.padding_samples is None else settings.padding_samples
    lowpass = ZeroPhase(cutoff, order, rate, settings.padding, min(samples, window.position.size - 1))
    return lowpass.respond(window.theta_m), lowpass.respond(window.position)


def _unmoved(theta_m: Array, sample_rate: float, settings: PaperSettings, second: float) -> str:
    """Reason for which the motor's motion cannot show a gap; empty when it can."""
    rest_speed = settings.times(second).rest_speed
    course = motion(theta_m, sample_rate, rest_speed, second)
    if course.moving == 0.0:
        return f"the motor never moved faster than {rest_speed:.3g} rad/s"
    if course.reversals < settings.reversals:
        return f"the motor changed direction {course.reversals} times, and {settings.reversals} are needed"
    return ""


def _start(theta_m: Array, prior: float) -> Array:
    """(gap, theta_d0) as in section 4.1: the previous gap, the motor's first angle less half of it in its direction."""
    direction = float(np.sign(theta_m[1] - theta_m[0]))
    return np.array([prior, theta_m[0] - 0.5 * prior * direction])


def _stated(
    blank: GapEstimate, settings: PaperSettings, residual: PlayResidual, minimum: Minimum, angle_origin: float
) -> GapEstimate:
    """Fill a blank estimate from a minimum."""
    std = residual.scale * standard_deviation(*residual.sensitivities(minimum.point), residual.values(minimum.point))
    total = math.hypot(std, settings.method_error)
    verdict = judge(residual, minimum, std, settings)
    known = verdict.status is GapStatus.OK
    return replace(
        blank,
        gap=verdict.gap,
        std=std if known else math.inf,
        std_total=total if known else math.inf,
        interval=verdict.interval(total),
        status=verdict.status,
        theta_d0=residual.first_screw_angle(verdict.gap, minimum.point) + angle_origin,
        reasons=verdict.reasons,
        rms=residual.unit * math.sqrt(minimum.cost),
        evaluations=minimum.evaluations,
    )


def _nothing(window: Window, servo: Servo, *reasons: str) -> GapEstimate:
    """Make the estimate of a window that does not show the gap, with the reasons."""
    return no_estimate(window.mid_time, reasons, servo.version, METHOD)
