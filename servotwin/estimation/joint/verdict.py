"""Estimate from a minimum of the joint fit: gap, parameters, spreads, status and reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servotwin.estimation.core.contacts import Gap, Travel, travel
from servotwin.estimation.core.response import response
from servotwin.estimation.core.visible import least_travel
from servotwin.estimation.estimate import GapEstimate, GapStatus, interval_95, no_estimate
from servotwin.estimation.joint.model import JointModel
from servotwin.estimation.joint.settings import SPREADS, JointSettings
from servotwin.plant.plants import Plant
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

METHOD = "joint"


@dataclass(frozen=True)
class Parameter:
    """A free parameter: value and standard deviation in its own unit, and its factor over the model's.

    "k/m" in 1/s^2 and "c/m" in 1/s are those of the last mass, "pitch" in m/rad, "k_B" in V s/rad, "delay" in s,
    "gap rate" in rad/s; the last two have no factor (NaN). Of an axis that is fitted by its output error they have the
    names of that fit: "shaft stiffness" and "shaft damping" of a free shaft, "stiffness" and "damping" of the chain
    behind a screw that the gap holds (of its first link), "ratio" of the transmission, "mass ratio" of last and first
    mass, "load stiffness", "load damping", "load friction", "load force", and "delay" and "lag" in s without a factor.
    The masses are as stated: the motion shows stiffnesses, dampings, friction and force over them.
    """

    value: float
    std: float
    factor: float = math.nan


@dataclass(frozen=True, eq=False, repr=False)
class JointEstimate:
    """Gaps of all windows and the parameters that they share.

    Attributes
    ----------
    gaps : tuple of GapEstimate
        One for each window.
    parameters : mapping
        Name -> `Parameter`; "delay" and "gap rate" are those of the last window that counted. Empty where an axis's
        window was refused before any fit.
    names : tuple of str
        Order of `covariance`: "gap" (rad), of a servo "place", then the parameters; logarithms where they have a
        factor.
    covariance : (P, P) array
        Of the last window that counted, with all that the others say of the parameters they share.
    servo : Servo or Axis
        With the fitted numbers.
    reasons : tuple of str
        What to know about the parameters, one sentence each.
    """

    gaps: tuple[GapEstimate, ...]
    parameters: Mapping[str, Parameter]
    names: tuple[str, ...]
    covariance: Array
    servo: Plant
    reasons: tuple[str, ...]

    def __repr__(self) -> str:
        """Number of windows, those that are ok, and the last gap in one line."""
        count, right = len(self.gaps), sum(gap.ok for gap in self.gaps)
        return f"<JointEstimate of {count} windows, {right} ok; the last: {self.gap!r}>"

    @property
    def gap(self) -> GapEstimate:
        """The last window's."""
        return self.gaps[-1]


@dataclass(frozen=True, eq=False)
class JointFit:
    """Result of a fit for one window.

    Attributes
    ----------
    model : JointModel
    point : (P,) array
    covariance : (P, P) array
        For residuals of variance 1.
    evaluations : int
    objection : str
        Reason for which nothing may be concluded from the fit; empty without one.
    contradiction : str
        Contradiction by the other windows; empty without one.
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


def estimate_of(gaps: tuple[GapEstimate, ...], fit: JointFit, settings: JointSettings) -> JointEstimate:
    """Assemble the gaps of all windows and the parameters of the last window that counted."""
    model, covariance = fit.model, settings.inflation**2 * fit.covariance
    stds = dict(zip(model.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    names = [name for name in model.names if name in SPREADS or name == "delay"]
    parameters = {name: _parameter(model.servo, name, fit.values[name], stds[name]) for name in names}
    remarks = _remarks(names, stds, settings)
    return JointEstimate(gaps, parameters, model.names, covariance, model.adapted(fit.values), remarks)


def window_estimate(fit: JointFit, settings: JointSettings) -> GapEstimate:
    """Make the gap estimate of a window from its fit."""
    model, std = fit.model, fit.std(settings)
    status, reasons = _verdict(fit, std, settings)
    blank = replace(
        no_estimate(model.window.mid_time, reasons, model.servo.version, METHOD),
        status=status,
        rms=fit.rms,
        evaluations=fit.evaluations,
    )
    gap, total = fit.values["gap"], math.hypot(std, settings.model_error_rad)
    _, theta_m, at = model.screw(fit.values)
    if status is GapStatus.LOWER_BOUND:
        bound = interval_95(pushed(model, theta_m, at).lead, total)[0]
        return replace(blank, gap=bound, interval=(bound, math.inf))
    if status is not GapStatus.OK:
        return blank
    first = 0.0 if model.window.theta_m is None else float(model.window.theta_m[0])
    known = replace(blank, gap=gap, std=std, std_total=total, interval=interval_95(gap, total))
    return replace(known, theta_d0=first + at.theta_d0)


def _verdict(fit: JointFit, std: float, settings: JointSettings) -> tuple[GapStatus, tuple[str, ...]]:
    """Status of the minimum, and the reasons where it is not OK."""
    if fit.objection:
        return GapStatus.UNIDENTIFIABLE, (fit.objection,)
    mismatch = fit.contradiction or mismatched(fit, settings)
    if mismatch:
        return GapStatus.MODEL_MISMATCH, (mismatch,)
    if not std <= settings.largest_std_rad:
        known = (
            f"the gap is known to {math.degrees(std):.3g} deg only" if math.isfinite(std) else "nothing shows the gap"
        )
        return GapStatus.UNIDENTIFIABLE, (f"{known}, and {math.degrees(settings.largest_std_rad):.3g} deg are allowed",)
    travel = settings.contact_travel_rad
    needed = least_travel(fit.values["gap"], fit.model.servo.encoder_resolution) if travel is None else travel
    status, reasons = _by_contacts(fit, needed)
    bound = at_bound(fit, settings)
    if not bound:
        return status, reasons
    return GapStatus.LOWER_BOUND if status is GapStatus.OK else status, (bound, *reasons)


def at_bound(fit: JointFit, settings: JointSettings) -> str:
    """Reason for which a fit shows only that the gap is large: the search ended at its bound; empty otherwise."""
    largest = settings.largest_gap_rad
    # A search may stop a little before the bound, so that one standard deviation counts as there.
    if fit.values["gap"] < largest - math.hypot(fit.std(settings), settings.model_error_rad):
        return ""
    return f"the best fit lies at largest_gap_rad = {math.degrees(largest):.6g} deg: the gap is probably larger"


def mismatched(fit: JointFit, settings: JointSettings) -> str:
    """Reason for which the model does not fit the window; empty where it does."""
    variation = float(np.std(fit.model.measured))
    if variation > 0.0 and fit.rms > settings.unexplained * variation:
        return f"the model leaves {100.0 * fit.rms / variation:.0f} % of the measured motion unexplained"
    for name, value in fit.values.items():
        if name in SPREADS and abs(value) >= 3.999 * settings.spread(name):
            return f"{name} would have to leave its bounds of four times the spread of {settings.spread(name):.3g}"
        if name == "delay" and abs(value) >= 0.999 * settings.delay_limit:
            return f"the channels would have to be out of step by more than {1e3 * settings.delay_limit:.3g} ms"
    return ""


def _by_contacts(fit: JointFit, needed: float) -> tuple[GapStatus, tuple[str, ...]]:
    """Decide by contacts: a screw pushed both ways shows the gap, one pushed one way only a bound."""
    _, theta_m, at = fit.model.screw(fit.values)
    motion = pushed(fit.model, theta_m, at)
    if min(motion.forwards, motion.backwards) >= needed:
        return GapStatus.OK, ()
    ways = f"{math.degrees(motion.forwards):.3g} deg forwards and {math.degrees(motion.backwards):.3g} deg backwards"
    reason = f"the screw was pushed {ways}, and {math.degrees(needed):.3g} deg are needed both ways"
    far = max(motion.forwards, motion.backwards) >= needed
    return GapStatus.LOWER_BOUND if far else GapStatus.UNIDENTIFIABLE, (reason,)


def pushed(model: JointModel, theta_m: Array, at: Gap) -> Travel:
    """Sum up the screw's motion without the end of the window, to which the last mass has not answered."""
    unseen = model.margin + round(response(model.servo, model.rate).unseen * model.rate)
    return travel(theta_m[: max(2, theta_m.size - unseen)], at)


def _parameter(servo: Servo, name: str, value: float, std: float) -> Parameter:
    """Convert a fitted parameter into its own unit."""
    if name in ("delay", "gap rate"):
        return Parameter(value, std)
    own = {
        "k/m": servo.stiffnesses[-1] / servo.masses[-1],
        "c/m": servo.dampings[-1] / servo.masses[-1],
        "pitch": servo.p,
        "k_d": servo.k_d,
        "k_B": servo.k_B,
    }[name]
    factor = math.exp(value)
    return Parameter(float(own * factor), float(own * factor * std), factor)


def _remarks(names: list[str], stds: Mapping[str, float], settings: JointSettings) -> tuple[str, ...]:
    """Name the parameters about which the window adds hardly any information."""
    return tuple(
        f"{name} rests on what was known before: the window alone does not show it"
        for name in names
        if name in SPREADS and not stds[name] < 0.9 * settings.inflation * settings.spread(name)
    )
