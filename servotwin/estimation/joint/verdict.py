"""Estimate from a minimum of the joint fit: gap, parameters, spreads, status and reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servotwin.estimation.core.contacts import Gap, Travel, travel
from servotwin.estimation.core.response import response
from servotwin.estimation.estimate import GapEstimate, GapStatus, interval_95, no_estimate
from servotwin.estimation.joint.model import JointModel
from servotwin.estimation.joint.settings import SPREADS, JointSettings
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
    """Gaps and parameters.

    Attributes
    ----------
    gaps : tuple of GapEstimate
        One for each window.
    parameters : mapping
        Name -> `Parameter`; "delay" and "gap rate" are those of the last window that counted.
    names : tuple of str
        Order of `covariance`: "gap" (rad), "place", then the parameters; logarithms where they have a factor.
    covariance : (P, P) array
        Of the last window that counted, with all that the others say of the parameters they share.
    servo : Servo
        With the fitted numbers.
    reasons : tuple of str
        What to know about the parameters, one sentence each.
    """

    gaps: tuple[GapEstimate, ...]
    parameters: Mapping[str, Parameter]
    names: tuple[str, ...]
    covariance: Array
    servo: Servo
    reasons: tuple[str, ...]

    @property
    def gap(self) -> GapEstimate:
        """The last window's."""
        return self.gaps[-1]


@dataclass(frozen=True, eq=False)
class JointFit:
    """End of a fit, for one window.

    Attributes
    ----------
    model : JointModel
    point : (P,) array
    covariance : (P, P) array
        For residuals of variance 1.
    evaluations : int
    objection : str
        Why nothing may be concluded from it; empty when there is no reason.
    contradiction : str
        Why the model does not belong to the window, other windows say; empty when they do not.
    """

    model: JointModel
    point: Array
    covariance: Array
    evaluations: int
    objection: str = ""
    contradiction: str = ""

    @property
    def values(self) -> dict[str, float]:
        """Values of the parameters by name."""
        return dict(zip(self.model.names, self.point.tolist(), strict=True))

    @cached_property
    def rms(self) -> float:
        """Root mean square of the residual at the full rate, m."""
        return math.sqrt(self.model.cost(self.values, np.asarray) / self.model.measured.size)

    def std(self, settings: JointSettings) -> float:
        """Standard deviation of the gap, calibrated, rad."""
        variance = float(self.covariance[0, 0])
        return math.hypot(settings.inflation * math.sqrt(variance), settings.numeric_error_rad)


def estimate_of(gaps: tuple[GapEstimate, ...], found: JointFit, settings: JointSettings) -> JointEstimate:
    """The gaps of all windows, and the parameters as the last that counted knows them."""
    model, covariance = found.model, settings.inflation**2 * found.covariance
    stds = dict(zip(model.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    names = [name for name in model.names if name in SPREADS or name == "delay"]
    parameters = {name: _parameter(model.servo, name, found.values[name], stds[name]) for name in names}
    remarks = _remarks(names, stds, settings)
    return JointEstimate(gaps, parameters, model.names, covariance, model.adapted(found.values), remarks)


def stated(found: JointFit, settings: JointSettings) -> GapEstimate:
    """The estimate of a window's gap that a minimum makes."""
    model, std = found.model, found.std(settings)
    status, reasons = _verdict(found, std, settings)
    blank = replace(
        no_estimate(model.window.mid_time, reasons, model.servo.version, METHOD),
        status=status,
        rms=found.rms,
        evaluations=found.evaluations,
    )
    gap, total = found.values["gap"], math.hypot(std, settings.model_error_rad)
    _, theta_m, at = model.screw(found.values)
    if status is GapStatus.LOWER_BOUND:
        bound = interval_95(pushed(model, theta_m, at).lead, total)[0]
        return replace(blank, gap=bound, interval=(bound, math.inf))
    if status is not GapStatus.OK:
        return blank
    first = 0.0 if model.window.theta_m is None else float(model.window.theta_m[0])
    known = replace(blank, gap=gap, std=std, std_total=total, interval=interval_95(gap, total))
    return replace(known, theta_d0=first + at.theta_d0)


def _verdict(found: JointFit, std: float, settings: JointSettings) -> tuple[GapStatus, tuple[str, ...]]:
    """Status of the minimum, and the reasons where it is not OK."""
    if found.objection:
        return GapStatus.UNIDENTIFIABLE, (found.objection,)
    mismatch = found.contradiction or mismatched(found, settings)
    if mismatch:
        return GapStatus.MODEL_MISMATCH, (mismatch,)
    if not std <= settings.largest_std_rad:
        known = (
            f"the gap is known to {math.degrees(std):.3g} deg only" if math.isfinite(std) else "nothing shows the gap"
        )
        return GapStatus.UNIDENTIFIABLE, (f"{known}, and {math.degrees(settings.largest_std_rad):.3g} deg are allowed",)
    status, reasons = _by_contacts(found, settings.contact_travel_rad)
    bound = at_bound(found, settings)
    if not bound:
        return status, reasons
    return GapStatus.LOWER_BOUND if status is GapStatus.OK else status, (bound, *reasons)


def at_bound(found: JointFit, settings: JointSettings) -> str:
    """Reason why a fit says no more than that the gap is large: the search ended at its bound; empty otherwise."""
    largest = settings.largest_gap_rad
    # A search may stop a little before the bound, so that one standard deviation counts as there.
    if found.values["gap"] < largest - math.hypot(found.std(settings), settings.model_error_rad):
        return ""
    return f"the best fit lies at largest_gap_rad = {math.degrees(largest):.6g} deg: the gap is probably larger"


def mismatched(found: JointFit, settings: JointSettings) -> str:
    """Reason why the model does not belong to the window; empty when it does."""
    variation = float(np.std(found.model.measured))
    if variation > 0.0 and found.rms > settings.unexplained * variation:
        return f"the model leaves {100.0 * found.rms / variation:.0f} % of the measured motion unexplained"
    for name, value in found.values.items():
        if name in SPREADS and abs(value) >= 3.999 * settings.spread(name):
            return f"{name} would have to leave its bounds of four times the spread of {settings.spread(name):.3g}"
        if name == "delay" and abs(value) >= 0.999 * settings.largest_delay_s:
            return f"the channels would have to be out of step by more than {1e3 * settings.largest_delay_s:.3g} ms"
    return ""


def _by_contacts(found: JointFit, needed: float) -> tuple[GapStatus, tuple[str, ...]]:
    """Pushed both ways, the screw shows the gap; pushed one way only, a bound."""
    _, theta_m, at = found.model.screw(found.values)
    seen = pushed(found.model, theta_m, at)
    if min(seen.forwards, seen.backwards) >= needed:
        return GapStatus.OK, ()
    ways = f"{math.degrees(seen.forwards):.3g} deg forwards and {math.degrees(seen.backwards):.3g} deg backwards"
    reason = f"the screw was pushed {ways}, and {math.degrees(needed):.3g} deg are needed both ways"
    far = max(seen.forwards, seen.backwards) >= needed
    return GapStatus.LOWER_BOUND if far else GapStatus.UNIDENTIFIABLE, (reason,)


def pushed(model: JointModel, theta_m: Array, at: Gap) -> Travel:
    """Sum up the screw's motion without the end of the window, to which the last mass has not answered."""
    unseen = model.margin + round(response(model.servo, model.rate).unseen * model.rate)
    return travel(theta_m[: max(2, theta_m.size - unseen)], at)


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
    """Name the parameters that the window hardly informed."""
    return tuple(
        f"{name} rests on what was known before: the window alone does not show it"
        for name in names
        if name in SPREADS and not stds[name] < 0.9 * settings.inflation * settings.spread(name)
    )
