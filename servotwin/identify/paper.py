"""The paper's estimator (section 4.1, Eqs 22-23, Appendix): observer, play operator and unconstrained BFGS.

It is kept as published, its bias included: what the observer has not yet forgotten at k_s pulls the gap (erratum E8).
What is added is only what an answer must say of itself: a spread, and a refusal where the window cannot show the gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.identify.bfgs import Minimum, minimise
from servotwin.identify.estimate import NOTHING_KNOWN, GapEstimate, GapStatus, Interval
from servotwin.identify.information import standard_deviation
from servotwin.identify.motion import motion
from servotwin.identify.observer import observer
from servotwin.identify.residual import PlayResidual, zero_phase
from servotwin.identify.window import MINIMUM_SAMPLES, Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

METHOD = "paper"
_GRADIENT_TOLERANCE, _STEP_TOLERANCE = 1e-8, 1e-9  # of the motor's range: 1e-5 deg in the paper's loop
_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Settings:
    """Settings of the paper's estimator.

    Parameters
    ----------
    alpha : float
        Observer poles at -alpha, rad/s.
    settle_s : float
        k_s T_s: what the cost leaves out at the start of a window, s.
    lowpass_hz : float, optional
        Cut-off of the zero-phase Butterworth on both channels, Hz (20 for noisy windows, section 4.3); None: none.
    lowpass_order : int
        Order of one pass; run forwards and backwards it counts twice (erratum E18).
    reversals : int
        How often the motor must change direction. This and `rest_speed` carry names of ours (erratum E14).
    rest_speed : float
        rad/s; slower counts as rest.
    contact_travel : float
        rad: how far the fitted screw must be pushed in each contact.
    method_error : float
        rad: standard deviation taken for the method's own bias, in `std_total`. Measured: tests/test_paper_loop.py.
    unexplained : float
        Residual over variation of the filtered position above which the model does not belong to the window.
    """

    alpha: float = 40.0
    settle_s: float = 0.25
    lowpass_hz: float | None = None
    lowpass_order: int = 10
    reversals: int = 1
    rest_speed: float = 0.1
    contact_travel: float = math.radians(0.5)
    method_error: float = math.radians(0.5)
    unexplained: float = 0.5

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is None and item.name == "lowpass_hz":
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
                raise InvalidInput(f"estimator {item.name} = {value!r}: must be a finite number of at least 0")
        for name in ("alpha", "lowpass_hz", "lowpass_order"):
            if getattr(self, name) == 0:
                raise InvalidInput(f"estimator {name} = 0: must be greater than 0")
        for name in ("lowpass_order", "reversals"):
            if not isinstance(getattr(self, name), int):
                raise InvalidInput(f"estimator {name} = {getattr(self, name)!r}: must be an integer")


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
    skip = math.ceil(settings.settle_s * window.sample_rate - 1e-9)
    model = observer(servo, settings.alpha)
    residual = PlayResidual.of(theta_m, position, window.sample_rate, model, servo.p, skip)
    start = _start(theta_m, prior or 0.0) / residual.scale
    found = minimise(residual.slope, start, _GRADIENT_TOLERANCE, _STEP_TOLERANCE)
    return _judged(window, servo, settings, residual, found)


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
    return zero_phase(window.theta_m, cutoff, order, rate), zero_phase(window.position, cutoff, order, rate)


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


def _judged(window: Window, servo: Servo, settings: Settings, residual: PlayResidual, found: Minimum) -> GapEstimate:
    """What the minimum is worth."""
    fitted, start = (float(value) * residual.scale for value in found.point)
    std = residual.scale * standard_deviation(residual.sensitivities(found.point), residual.values(found.point))
    total = math.hypot(std, settings.method_error)
    status, gap, reasons = _verdict(residual, found, fitted, total, settings)
    known = status in (GapStatus.OK, GapStatus.LOWER_BOUND)
    first = float(residual.theta_m[0]) * residual.scale
    return replace(
        _nothing(window, servo, *reasons),
        gap=gap,
        std=std if status is GapStatus.OK else math.inf,
        std_total=total if status is GapStatus.OK else math.inf,
        interval=_interval(status, gap, total),
        status=status,
        theta_d0=min(max(start, first - 0.5 * gap), first + 0.5 * gap) if known else math.nan,
        rms=residual.unit * math.sqrt(found.cost),
        evaluations=found.evaluations,
    )


def _verdict(
    residual: PlayResidual, found: Minimum, fitted: float, total: float, settings: Settings
) -> tuple[GapStatus, float, tuple[str, ...]]:
    """(status, gap, reasons) of a minimum at the total gap `fitted` (rad) with the standard deviation `total` (rad)."""
    if not found.converged:
        return GapStatus.UNIDENTIFIABLE, math.nan, (f"the minimisation did not converge: {found.message}",)
    unexplained = residual.unexplained(found.cost)
    if unexplained > settings.unexplained:
        reason = f"the model leaves {100.0 * unexplained:.0f} % of the measured motion unexplained"
        return GapStatus.MODEL_MISMATCH, math.nan, (reason,)
    if math.isinf(total):
        return GapStatus.UNIDENTIFIABLE, math.nan, ("the measurements do not depend on the gap",)
    if fitted < 0.0:
        return _negative(fitted, total)
    return _by_contacts(residual, found, fitted, settings.contact_travel)


def _negative(fitted: float, total: float) -> tuple[GapStatus, float, tuple[str, ...]]:
    """A minimum at a negative gap: zero when that lies within its spread, otherwise a sign that the model is wrong."""
    reason = f"the best fit has a negative gap of {math.degrees(fitted):.3g} deg"
    if -fitted <= _NORMAL_95 * total:
        return GapStatus.OK, 0.0, (f"{reason}, taken as 0",)
    return GapStatus.MODEL_MISMATCH, math.nan, (reason,)


def _by_contacts(
    residual: PlayResidual, found: Minimum, fitted: float, needed: float
) -> tuple[GapStatus, float, tuple[str, ...]]:
    """Pushed both ways, the screw shows the gap; pushed one way only, that it is as wide as the motor's free travel."""
    forwards, backwards, free = residual.screw_motion(found.point)
    if min(forwards, backwards) >= needed:
        return GapStatus.OK, fitted, ()
    pushed = f"{math.degrees(forwards):.3g} deg forwards and {math.degrees(backwards):.3g} deg backwards"
    reason = f"the screw was pushed {pushed}, and {math.degrees(needed):.3g} deg are needed both ways"
    if max(forwards, backwards) >= needed:
        return GapStatus.LOWER_BOUND, free, (reason,)
    return GapStatus.UNIDENTIFIABLE, math.nan, (reason,)


def _interval(status: GapStatus, gap: float, total: float) -> Interval:
    if status is GapStatus.OK:
        return max(0.0, gap - _NORMAL_95 * total), gap + _NORMAL_95 * total
    return (max(0.0, gap - _NORMAL_95 * total), math.inf) if status is GapStatus.LOWER_BOUND else NOTHING_KNOWN


def _nothing(window: Window, servo: Servo, *reasons: str) -> GapEstimate:
    """An answer that says only why there is none."""
    return GapEstimate(
        gap=math.nan,
        std=math.inf,
        std_total=math.inf,
        interval=NOTHING_KNOWN,
        status=GapStatus.UNIDENTIFIABLE,
        time=window.mid_time,
        reasons=reasons,
        model_version=servo.version,
        method=METHOD,
    )
