"""What a minimum of the joint fit is worth: gap, parameters, spreads, status and reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from servotwin.identify.core.contacts import travel
from servotwin.identify.estimate import NOTHING_KNOWN, GapEstimate, GapStatus, interval_95
from servotwin.identify.joint.model import JointModel
from servotwin.identify.joint.search import Stand
from servotwin.identify.joint.settings import SPREADS, JointSettings
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

METHOD = "joint"


@dataclass(frozen=True)
class Parameter:
    """A free parameter: value and standard deviation in its own unit, and its factor over the servo's.

    "k/m" in 1/s^2 and "c/m" in 1/s are those of the last mass, "pitch" in m/rad, "k_B" in V s/rad, "delay" in s,
    "gap rate" in rad/s; the last two have no factor (NaN).
    """

    value: float
    std: float
    factor: float = math.nan


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Gap and parameters.

    Attributes
    ----------
    gap : GapEstimate
    parameters : mapping
        Name -> `Parameter`.
    names : tuple of str
        Order of `covariance`: "gap" (rad), "place", then the parameters; logarithms where they have a factor.
    covariance : (P, P) array
    servo : Servo
        With the fitted numbers.
    reasons : tuple of str
        What to know about the parameters, one sentence each.
    """

    gap: GapEstimate
    parameters: Mapping[str, Parameter]
    names: tuple[str, ...]
    covariance: Array
    servo: Servo
    reasons: tuple[str, ...]


def stated(model: JointModel, found: Stand, settings: JointSettings, objection: str) -> JointEstimate:
    """The estimate that a minimum makes."""
    values = dict(zip(model.names, found.point.tolist(), strict=True))
    servo, theta_m, at = model.screw(values)
    covariance = settings.inflation**2 * found.covariance()
    stds = dict(zip(model.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    status, reasons = _verdict(model, found, stds["gap"], settings, objection)
    first = 0.0 if model.window.theta_m is None else float(model.window.theta_m[0])
    gap = _gap_estimate(model, values, stds["gap"], (status, reasons), settings)
    gap = replace(
        gap, evaluations=found.evaluations, theta_d0=first + at.theta_d0 if math.isfinite(gap.gap) else math.nan
    )
    if status is GapStatus.LOWER_BOUND:
        gap = replace(gap, gap=travel(theta_m, at).lead)
    names = [name for name in model.names if name in SPREADS or name == "delay"]
    parameters = {name: _parameter(model.servo, name, values[name], stds[name]) for name in names}
    return JointEstimate(gap, parameters, model.names, covariance, servo, _remarks(names, stds, settings))


def _gap_estimate(
    model: JointModel,
    values: Mapping[str, float],
    std: float,
    verdict: tuple[GapStatus, tuple[str, ...]],
    settings: JointSettings,
) -> GapEstimate:
    status, reasons = verdict
    known, gap, total = status is GapStatus.OK, values["gap"], math.hypot(std, settings.model_error_rad)
    interval = NOTHING_KNOWN
    if status in (GapStatus.OK, GapStatus.LOWER_BOUND):
        low, high = interval_95(gap, total)
        interval = low, high if known else math.inf
    return GapEstimate(
        gap=gap if known else math.nan,
        std=std if known else math.inf,
        std_total=total if known else math.inf,
        interval=interval,
        status=status,
        time=model.window.mid_time,
        reasons=reasons,
        model_version=model.servo.version,
        method=METHOD,
    )


def _verdict(
    model: JointModel, found: Stand, std: float, settings: JointSettings, objection: str
) -> tuple[GapStatus, tuple[str, ...]]:
    """What the minimum may be used for, and why not for more."""
    if objection or not found.converged:
        return GapStatus.UNIDENTIFIABLE, (objection or "the search did not converge",)
    mismatch = _mismatch(model, found, settings)
    if mismatch:
        return GapStatus.MODEL_MISMATCH, (mismatch,)
    if not std <= settings.largest_std_rad:
        known = (
            f"the gap is known to {math.degrees(std):.3g} deg only" if math.isfinite(std) else "nothing shows the gap"
        )
        return GapStatus.UNIDENTIFIABLE, (f"{known}, and {math.degrees(settings.largest_std_rad):.3g} deg are allowed",)
    return _by_contacts(model, found, settings.contact_travel_rad)


def _mismatch(model: JointModel, found: Stand, settings: JointSettings) -> str:
    """Why the model does not belong to the window; empty when it does."""
    share = unexplained(model, found.point)
    if share > settings.unexplained:
        return f"the model leaves {100.0 * share:.0f} % of the measured motion unexplained"
    for name, value in zip(model.names, found.point.tolist(), strict=True):
        if name in SPREADS and abs(value) >= 3.999 * settings.spread(name):
            return f"{name} would have to leave its bounds of four times the spread of {settings.spread(name):.3g}"
        if name == "delay" and abs(value) >= 0.999 * settings.largest_delay_s:
            return f"the channels would have to be out of step by more than {1e3 * settings.largest_delay_s:.3g} ms"
    return ""


def unexplained(model: JointModel, point: Array) -> float:
    """Residual over variation of the position, rms both, at the full rate."""
    values = dict(zip(model.names, point.tolist(), strict=True))
    variation = float(np.std(model.measured))
    return math.sqrt(model.cost(values, np.asarray) / model.measured.size) / variation if variation > 0.0 else math.inf


def _by_contacts(model: JointModel, found: Stand, needed: float) -> tuple[GapStatus, tuple[str, ...]]:
    """Pushed both ways, the screw shows the gap; pushed one way only, a bound."""
    _, theta_m, at = model.screw(dict(zip(model.names, found.point.tolist(), strict=True)))
    pushed = travel(theta_m, at)
    if min(pushed.forwards, pushed.backwards) >= needed:
        return GapStatus.OK, ()
    ways = f"{math.degrees(pushed.forwards):.3g} deg forwards and {math.degrees(pushed.backwards):.3g} deg backwards"
    reason = f"the screw was pushed {ways}, and {math.degrees(needed):.3g} deg are needed both ways"
    far = max(pushed.forwards, pushed.backwards) >= needed
    return GapStatus.LOWER_BOUND if far else GapStatus.UNIDENTIFIABLE, (reason,)


def _parameter(servo: Servo, name: str, value: float, std: float) -> Parameter:
    """In its own unit."""
    if name in ("delay", "gap rate"):
        return Parameter(value, std)
    own = {
        "k/m": servo.stiffnesses[-1] / servo.masses[-1],
        "c/m": servo.dampings[-1] / servo.masses[-1],
        "pitch": servo.p,
        "k_B": servo.k_B,
    }[name]
    factor = math.exp(value)
    return Parameter(float(own * factor), float(own * factor * std), factor)


def _remarks(names: list[str], stds: Mapping[str, float], settings: JointSettings) -> tuple[str, ...]:
    """Which parameters the window hardly informed."""
    return tuple(
        f"{name} rests on what was known before: the window alone does not show it"
        for name in names
        if name in SPREADS and not stds[name] < 0.9 * settings.inflation * settings.spread(name)
    )
