"""What a minimum of the paper's cost is worth: the gap, a bound, or why nothing is known."""

from __future__ import annotations

import math
from typing import NamedTuple

from servotwin.estimation.estimate import NORMAL_95, NOTHING_KNOWN, GapStatus, Interval, interval_95
from servotwin.estimation.paper.bfgs import Minimum
from servotwin.estimation.paper.residual import PlayResidual
from servotwin.estimation.paper.settings import Settings


class Verdict(NamedTuple):
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


def judge(residual: PlayResidual, found: Minimum, std: float, settings: Settings) -> Verdict:
    """The verdict on a minimum with the statistical standard deviation `std` (rad)."""
    objection = _objection(residual, found, std, settings)
    if objection is not None:
        return objection
    fitted, total = float(found.point[0]) * residual.scale, math.hypot(std, settings.method_error)
    widest = max(0.0, fitted) + NORMAL_95 * total
    if residual.scale < widest:
        moved = f"the motor moved by {math.degrees(residual.scale):.3g} deg"
        return _unknown(f"{moved}, less than the {math.degrees(widest):.3g} deg that the gap may have")
    verdict = _by_contacts(residual, found, max(0.0, fitted), settings.contact_travel)
    return _negative(fitted, total) if fitted < 0.0 and verdict.status is GapStatus.OK else verdict


def _objection(residual: PlayResidual, found: Minimum, std: float, settings: Settings) -> Verdict | None:
    """Why the minimum says nothing of the gap, if so."""
    if not found.converged:
        return _unknown(f"the minimisation did not converge: {found.message}")
    share = residual.unexplained(found.cost)
    if share > settings.unexplained:
        reason = f"the model leaves {100.0 * share:.0f} % of the measured motion unexplained"
        return Verdict(GapStatus.MODEL_MISMATCH, math.nan, (reason,))
    if math.isinf(std):
        return _unknown("the measurements do not depend on the gap")
    if std > settings.largest_std:
        allowed = math.degrees(settings.largest_std)
        return _unknown(f"the gap is known to {math.degrees(std):.3g} deg only, and {allowed:.3g} deg are allowed")
    return None


def _negative(fitted: float, std: float) -> Verdict:
    """A minimum at a negative gap: zero when that lies within its spread, otherwise a sign that the model is wrong."""
    reason = f"the best fit has a negative gap of {math.degrees(fitted):.3g} deg"
    if -fitted <= NORMAL_95 * std:
        return Verdict(GapStatus.OK, 0.0, (f"{reason}, taken as 0",))
    return Verdict(GapStatus.MODEL_MISMATCH, math.nan, (reason,))


def _by_contacts(residual: PlayResidual, found: Minimum, fitted: float, needed: float) -> Verdict:
    """Pushed both ways, the screw shows the gap; pushed one way only, that it is as wide as the motor's free travel."""
    forwards, backwards, free = residual.screw_motion(found.point)
    if min(forwards, backwards) >= needed:
        return Verdict(GapStatus.OK, fitted, ())
    pushed = f"{math.degrees(forwards):.3g} deg forwards and {math.degrees(backwards):.3g} deg backwards"
    reason = f"the screw was pushed {pushed}, and {math.degrees(needed):.3g} deg are needed both ways"
    if max(forwards, backwards) >= needed:
        return Verdict(GapStatus.LOWER_BOUND, free, (reason,))
    return _unknown(reason)


def _unknown(reason: str) -> Verdict:
    return Verdict(GapStatus.UNIDENTIFIABLE, math.nan, (reason,))
