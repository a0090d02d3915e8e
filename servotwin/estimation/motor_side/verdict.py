"""Verdict on a fit from the motor's side: status, reasons and spread of a gap."""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.estimate import NORMAL_95, GapStatus
from servotwin.estimation.motor_side.held_motion import HeldShaft
from servotwin.estimation.motor_side.problem import MotorProblem
from servotwin.estimation.motor_side.settings import MotorSideSettings
from servotwin.estimation.output_error.fit import Fit, Search, descend, one_flank
from servotwin.estimation.output_error.mismatches import differing_halves, grown, unusual_numbers
from servotwin.estimation.output_error.models import HALF
from servotwin.estimation.output_error.search import explains, rms
from servotwin.estimation.output_error.verdict import JudgedFit

_BELIEVED = 60.0  # rise of the cost without the gap, or without the second flank, over the noise's variance
_RIVAL = 30.0  # the same of another gap that explains the window as well
_UNUSUAL = 3.3  # standard deviations of a friction or damping beforehand
DOUBT = 3.0  # interval over the computed one: friction is not as modelled
_MISLED = 0.2  # of what the gap does not explain: error of the gap that a wrong model makes
_ROUNDED = 0.5  # of a count: standard deviation of an error that does not average out
# Behind a screw that the gap holds each rest of the motor on its flank makes minima of its own, tens of per cent of the
# gap apart. Of 55 accepted windows (tuning) the four that left most, 0.8 to 3 % of the gap, were off by 0.2 to 40 %.
_LEFT, _LEFT_COUNTS = 0.005, 1.0  # of half the gap, counts: what a fit may leave beyond white noise there
_AROUND = (0.01, 0.03, 0.08, 0.2)  # of a gap, either way: where the cost is looked at
_STEPS = 5
# A load that crosses the gap for longer than its shaft's period is touched softly: the gap hides in shaft, damping and
# friction, along a valley that winds. Of 61 accepted windows of machines that nobody chose six were off by more than
# their half-width, all of this kind, 1.1 to 5.2 half-widths: three left more than noise, in three the cost beside the
# gap had not come to rest.
_SOFT = 1.0  # periods of the shaft, motor held
_AROUND_SOFT = (0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2)
_STEPS_SOFT = 15
_TOUCHED = 1e-6  # of half the gap: in contact


def judge(found: Search, settings: MotorSideSettings, unit: float) -> JudgedFit:
    """Decide on a fit; `unit` is the total gap at the motor (rad) per half gap at the load, for the words."""
    best, problem = found.best, found.problem
    half = float(best.values[HALF])
    shut = _shut(found)
    left = float(np.std(best.raw) / np.std(shut.raw))
    if reason := _unseen(found, shut, left, settings):
        return JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=(reason,))
    if reason := _misplaced(found, unit):
        return JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=(reason,))
    mismatches = (
        unusual_numbers(found, found.best.values)
        + _unusual_friction(found)
        + differing_halves(found, settings.gap_rate / unit)
    )
    if mismatches:
        return JudgedFit(GapStatus.MODEL_MISMATCH, reasons=mismatches)
    std = best.std(HALF, found.free)
    if math.isinf(std):
        return JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=("the measurements do not depend on the gap",))
    rivals = _rivals(found, half) / NORMAL_95
    model = math.hypot(settings.model_share, _MISLED * left) * half
    total = math.hypot(
        DOUBT * std, rivals, model, 0.5 * _ROUNDED * problem.count, grown(found, settings.gap_rate / unit)
    )
    allowed = max(settings.largest_share * half, 0.5 * settings.counts * problem.count)
    if math.hypot(DOUBT * std, rivals) > allowed:
        known, limit = math.degrees(unit * math.hypot(DOUBT * std, rivals)), math.degrees(unit * allowed)
        words = f"the gap is known to {known:.3g} deg only, and {limit:.3g} deg are allowed"
        return JudgedFit(GapStatus.UNIDENTIFIABLE, reasons=(words,))
    return JudgedFit(GapStatus.OK, half, math.hypot(DOUBT * std, rivals), total)


def _misplaced(found: Search, unit: float) -> str:
    """Sentence for a fit at a wrong minimum: of a held screw or a soft touch it leaves more than noise."""
    best, problem = found.best, found.problem
    held = isinstance(problem, MotorProblem) and isinstance(problem.model.shaft, HeldShaft)
    left = rms(best.raw)
    if not (held or _soft(found)) or left <= _LEFT * float(best.values[HALF]) or explains(problem, best, _LEFT_COUNTS):
        return ""
    slowly = "" if held else " and the load crosses the gap for longer than its soft shaft's period"
    return (
        f"the model leaves {math.degrees(0.5 * unit * left):.2g} deg of the motor's angle, which is more than noise"
        f"{slowly}: a rest or a contact comes at another time, or friction is of another kind"
    )


def _soft(found: Search) -> bool:
    """Tell whether the load of a free shaft usually crosses the gap for longer than the shaft's period."""
    problem = found.problem
    if not isinstance(problem, MotorProblem) or isinstance(problem.model.shaft, HeldShaft):
        return False
    half = abs(float(found.best.values[HALF]))
    motor, driven = problem.simulate(found.best.values, problem.model.slowing[1] * problem.model.speed)
    lead = motor - driven
    side = np.where(np.abs(lead) >= (1.0 - _TOUCHED) * half, np.sign(lead), 0.0)
    touched = np.flatnonzero(side)
    crossed = side[touched][1:] * side[touched][:-1] < 0.0
    times = np.diff(touched)[crossed] * problem.interval
    return times.size > 0 and float(np.median(times)) * problem.model.speed > 2.0 * math.pi * _SOFT


def _unusual_friction(found: Search) -> tuple[str, ...]:
    """List the frictions and dampings that would have to be far off: the motor's side tells them from a gap hardly."""
    unknowns = zip(found.problem.model.unknowns, found.best.values.tolist(), strict=True)
    return tuple(
        f"the {unknown.name} would be {math.exp(value):.2g} times that of the model"
        for unknown, value in unknowns
        if unknown.unit == "damping" and abs(value) > _UNUSUAL * unknown.std
    )


def _shut(found: Search) -> Fit:
    """The best fit without a gap."""
    free, values = found.free.copy(), found.best.values.copy()
    free[HALF], values[HALF] = False, 0.0
    rate = found.problem.model.slowing[1] * found.problem.model.speed
    return descend(found.problem, values, found.noise, free, 2 * _STEPS, rate)


def _unseen(found: Search, shut: Fit, left: float, settings: MotorSideSettings) -> str:
    """Reason for which the motor does not show the gap; empty: none."""
    best = found.best
    if (shut.cost - best.cost) / best.variance() < _BELIEVED:
        return "the motor feels no gap: friction, noise and counts hide it, or there is none"
    if (one_flank(found).cost - best.cost) / best.variance() < _BELIEVED:
        return "one flank explains what the motor feels nearly as well as two"
    if left > settings.explained:
        return (
            f"the gap explains too little of what the motor feels: {100.0 * left:.0f} % is left, against a model "
            f"without a gap, {100.0 * settings.explained:.0f} % is allowed; friction dominates, or the model is wrong"
        )
    return ""


def _rivals(found: Search, half: float) -> float:
    """Distance of the farthest half gap that explains the window nearly as well."""
    limit = found.best.cost + _RIVAL * found.best.variance()
    fits = [fit for fit in found.others if fit.cost < limit]
    soft = _soft(found)
    if not soft:
        shares = (sign * share for share in _AROUND for sign in (-1.0, 1.0))
        beside = (_at(found, found.best, half * (1.0 + share), _STEPS) for share in shares)
        fits += [fit for fit in beside if fit.cost < limit]
    far = max((abs(float(fit.values[HALF]) - half) for fit in fits), default=0.0)
    return max(far, half * _valley(found, half, limit)) if soft else far


def _valley(found: Search, half: float, limit: float) -> float:
    """Share of a half gap within which the cost stays below a limit, up to the next place where it does not."""
    farthest = 0.0
    for sign in (-1.0, 1.0):
        last = found.best
        for share, beyond in zip(_AROUND_SOFT, (*_AROUND_SOFT[1:], _AROUND_SOFT[-1]), strict=True):
            # The fit before is the nearer start in a winding valley, unless it was led astray.
            begun = [found.best] if last is found.best else [found.best, last]
            tried = [_at(found, each, half * (1.0 + sign * share), _STEPS_SOFT) for each in begun]
            fit = min(tried, key=lambda each: each.cost)
            if fit.cost < limit:
                last, farthest = fit, max(farthest, beyond)
    return farthest


def _at(found: Search, start: Fit, half: float, steps: int) -> Fit:
    """The best fit of a half gap from another one's unknowns."""
    free, values = found.free.copy(), start.values.copy()
    free[HALF], values[HALF] = False, half
    rate = found.problem.model.slowing[1] * found.problem.model.speed
    return descend(found.problem, values, found.noise, free, steps, rate)
