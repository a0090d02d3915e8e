"""The paper's estimator (section 4.1, Eqs 22-23, Appendix): observer, play operator and unconstrained BFGS.

It is kept as published, its bias included: what the observer has not yet forgotten at k_s pulls the gap (erratum E8).
What is added is only what an answer must say of itself: a spread, and a refusal where the window cannot show the gap.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus, no_estimate
from servotwin.estimation.paper.bfgs import Minimum, minimise
from servotwin.estimation.paper.information import standard_deviation
from servotwin.estimation.paper.motion import motion
from servotwin.estimation.paper.observer import observer
from servotwin.estimation.paper.residual import PlayResidual
from servotwin.estimation.paper.settings import Settings
from servotwin.estimation.paper.verdict import judge
from servotwin.estimation.paper.zero_phase import ZeroPhase
from servotwin.estimation.window import MINIMUM_SAMPLES, Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

__all__ = ["METHOD", "Settings", "estimate"]

METHOD = "paper"
_GRADIENT_TOLERANCE, _STEP_TOLERANCE = 1e-8, 1e-9  # of the motor's range: 1e-5 deg in the paper's loop


def estimate(window: Window, servo: Servo, prior: float | None, settings: Settings | None) -> GapEstimate:
    """The total gap (rad) that a window with theta_m and position shows.

    Parameters
    ----------
    window : Window
    servo : Servo
        The model, taken as exact.
    prior : float, optional
        The previous total gap, rad, from which the search starts; None: 0, the paper's first.
    settings : Settings, optional

    Raises
    ------
    InvalidInput
        No theta_m, a window too short for the observer to settle, a low-pass above half the sample rate.
    """
    settings = settings or Settings()
    theta_m, position = _channels(window, settings)
    refusal = _unmoved(theta_m, window.sample_rate, settings)
    if refusal:
        return _nothing(window, servo, refusal)
    model = observer(servo, settings.alpha)
    origin = float(position[0]) if settings.origin == "first" else 0.0
    angle_origin = origin / model.static_gain
    skip = math.ceil(settings.settle_s * window.sample_rate - 1e-9)
    measured = theta_m - angle_origin, position - origin
    residual = PlayResidual.of(*measured, window.sample_rate, model, servo.p, skip)
    start = _start(measured[0], prior or 0.0) / residual.scale
    found = minimise(residual.slope, start, _GRADIENT_TOLERANCE, _STEP_TOLERANCE, settings.iterations)
    return _stated(_nothing(window, servo), settings, residual, found, angle_origin)


def _channels(window: Window, settings: Settings) -> tuple[Array, Array]:
    """theta_m and position, low-passed where the settings say so."""
    if window.theta_m is None:
        raise InvalidInput(f"{window.where}the window has no theta_m: method 'paper' needs the motor's angle in rad")
    needed = settings.settle_s + MINIMUM_SAMPLES / window.sample_rate
    if window.duration < needed:
        raise InvalidInput(
            f"{window.where}the window lasts {window.duration:.6g} s: must be at least {needed:.6g} s, so that the "
            f"observer can settle for settle_s = {settings.settle_s:.6g} s"
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


def _unmoved(theta_m: Array, sample_rate: float, settings: Settings) -> str:
    """Why the motor's motion cannot show a gap; empty when it can."""
    seen = motion(theta_m, sample_rate, settings.rest_speed)
    if seen.moving == 0.0:
        return f"the motor never moved faster than {settings.rest_speed:.3g} rad/s"
    if seen.reversals < settings.reversals:
        return f"the motor changed direction {seen.reversals} times, and {settings.reversals} are needed"
    return ""


def _start(theta_m: Array, prior: float) -> Array:
    """(gap, theta_d0) as in section 4.1: the previous gap, the motor's first angle less half of it in its direction."""
    direction = float(np.sign(theta_m[1] - theta_m[0]))
    return np.array([prior, theta_m[0] - 0.5 * prior * direction])


def _stated(
    blank: GapEstimate, settings: Settings, residual: PlayResidual, found: Minimum, angle_origin: float
) -> GapEstimate:
    """The estimate that a minimum makes of a blank one."""
    std = residual.scale * standard_deviation(*residual.sensitivities(found.point), residual.values(found.point))
    total = math.hypot(std, settings.method_error)
    verdict = judge(residual, found, std, settings)
    known = verdict.status is GapStatus.OK
    return replace(
        blank,
        gap=verdict.gap,
        std=std if known else math.inf,
        std_total=total if known else math.inf,
        interval=verdict.interval(total),
        status=verdict.status,
        theta_d0=residual.first_screw_angle(verdict.gap, found.point) + angle_origin,
        reasons=verdict.reasons,
        rms=residual.unit * math.sqrt(found.cost),
        evaluations=found.evaluations,
    )


def _nothing(window: Window, servo: Servo, *reasons: str) -> GapEstimate:
    """An estimate that knows nothing, and why."""
    return no_estimate(window.mid_time, reasons, servo.version, METHOD)
