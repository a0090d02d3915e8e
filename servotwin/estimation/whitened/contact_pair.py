"""The gap from two windows of one contact each, on opposite sides, such as a calm loop makes of steps to and fro.

After a push forwards the screw rests half a gap behind the motor's furthest angle. The next window begins with the
screw there, wherever the motor has gone meanwhile, as long as the last mass is where it was; else the screw has moved
in proportion. If the motor then pushes backwards, the gap is its way between the two contacts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from servotwin.estimation.core.contacts import BY_RATE, BY_START, SCREW
from servotwin.estimation.core.least_squares import least_squares
from servotwin.estimation.estimate import NORMAL_95, GapEstimate, GapStatus, LastContact, OffsetReading, interval_95
from servotwin.estimation.whitened.doubt import way_doubt
from servotwin.estimation.whitened.estimator import WindowFit
from servotwin.estimation.whitened.fit import WhitenedFit
from servotwin.estimation.whitened.free_model import PITCH, FreeFit
from servotwin.estimation.whitened.gate import misfits, sure_of_contact, with_free_model
from servotwin.estimation.whitened.reduction import CONSTANT, PLACE, RESIDUAL, Point
from servotwin.estimation.whitened.shift import fastest

_AGREE = 3.0  # standard deviations by which the gaps of two pairs may differ
_ROUNDED = math.sqrt(1.0 / 12.0)  # of a count, at each contact


@dataclass(frozen=True)
class _Touch:
    """The motor's angle at which it touches the screw (rad), the last mass at rest then (m), and the latter's standard
    deviation (m)."""

    motor: float
    position: float
    std: float


@dataclass(frozen=True, eq=False)
class OneContact:
    """A window in which the motor pushed the screw one way only.

    Attributes
    ----------
    fitted : WindowFit
    side : float
        As of `LastContact`.
    single : FreeFit
        Fit of one contact in the widest gap, with the machine free within what is known of it.
    begin, end : _Touch
        On this side, with the screw where it was at first and at last.
    """

    fitted: WindowFit
    side: float
    single: FreeFit
    begin: _Touch
    end: _Touch

    @classmethod
    def of(cls, fitted: WindowFit) -> OneContact | None:
        """Read the contact from a fit; None where the window has none for certain, or two, or the model is exact."""
        aligned, learnt = fitted.aligned, fitted.learnt
        if aligned is None or learnt is None or learnt.beyond or not fitted.one_sided():
            return None
        motion, evidence, settings = fitted.evidence.travel, fitted.evidence, fitted.settings
        if max(motion.forwards, motion.backwards) < evidence.needed:
            return None
        if misfits(evidence, settings) or not sure_of_contact(evidence, settings):
            return None
        side = 1.0 if motion.forwards > motion.backwards else -1.0
        single = learnt.one_contact(_same_way(aligned.whitened.point, aligned.largest, side))
        return None if single is None else cls(fitted, side, single, *_touches(fitted, single.point, side))

    @property
    def way(self) -> float:
        """Motor's way to the contact, rad."""
        assert self.fitted.aligned is not None
        return self.side * (self.begin.motor - self.fitted.aligned.first)

    @cached_property
    def _beside(self) -> FreeFit:
        """The fit, or, where it begins so close to the contact that free motions hide it, the point a little off."""
        learnt, settings = self.fitted.learnt, self.fitted.settings
        assert learnt is not None
        if math.isfinite(self.single.covariance[1, 1]) and abs(self.single.point.place) < 1.0:
            return self.single
        gap, place = self.single.point
        place += self.side * 2.0 * settings.largest_std / gap
        start = np.array([gap, place, *self.single.factors])
        return learnt.problem.descend(start, (False, True), evaluations=1)

    @property
    def way_std(self) -> float:
        """Standard deviation of the motor's way to the contact, rad."""
        assert self.fitted.learnt is not None
        scale = self.fitted.learnt.scale(self.fitted.settings.calibration)
        return 0.5 * self.single.point.gap * math.sqrt(scale * self._beside.covariance[1, 1])

    @property
    def gain(self) -> float:
        """Position over the screw's angle at rest, m/rad."""
        return _fit_of(self.fitted).reduction.response.static_gain

    @property
    def rounded(self) -> float:
        """Standard deviation (rad) of one contact by the counts of both channels."""
        evidence, stated = self.fitted.evidence, self.fitted.servo.position_resolution
        return _ROUNDED * math.hypot(evidence.count, max(evidence.scale, stated / abs(self.gain)))

    def last(self) -> LastContact:
        """The contact for later windows."""
        std = math.hypot(self.end.std / self.gain, self.rounded)
        return LastContact(self.side, self.end.motor, self.end.position, std, self.fitted.window.mid_time)

    def shifted(self) -> float:
        """Change of the motor's way to the contact (rad) with the model free within its usual error, as far as the
        window tells the free model's."""
        fitted, start = self.fitted, self.single
        assert fitted.aligned is not None
        free = with_free_model(fitted.aligned, fitted.servo)
        other = free.descend(np.array([*start.point, *np.zeros(start.factors.size)]), (False, True))
        moved = 0.5 * start.point.gap * abs(other.point.place - start.point.place)
        variance = max(1.0, fitted.aligned.whitened.variance)
        return max(0.0, moved - NORMAL_95 * 0.5 * start.point.gap * math.sqrt(variance * other.covariance[1, 1]))

    def doubt(self) -> float:
        """Root mean square (rad) of what machines and sensors that are not as assumed can do to the way."""
        learnt, aligned = self.fitted.learnt, self.fitted.aligned
        assert learnt is not None
        assert aligned is not None
        at = np.array([*self._beside.point, *self._beside.factors])
        ramp = fastest(aligned.whitened.reduction, self.fitted.second)
        return way_doubt(learnt.problem, at, max(1.0, aligned.whitened.variance), aligned.delay, ramp)


@dataclass(frozen=True)
class Pair:
    """Result of two contacts.

    Attributes
    ----------
    contact : LastContact
        The later one, with the gap between both.
    estimate : GapEstimate or None
        None: the windows do not show the gap, or another one must confirm it.
    reason : str
        Why there is none; empty where there is no contact on the other side yet.
    """

    contact: LastContact
    estimate: GapEstimate | None = None
    reason: str = ""

    def added_to(self, alone: GapEstimate) -> GapEstimate:
        """The estimate of the later window alone, with the contact and the reason."""
        return replace(alone, contact=self.contact, reasons=(*alone.reasons, *filter(None, (self.reason,))))


def pair(here: OneContact, before: LastContact | None, prior: float | GapEstimate | None) -> Pair:
    """Estimate the gap from a window of one contact and the last contact of an earlier one on the other side.

    The estimate belongs to the middle between both windows, because half of the gap is that of each. Without a `prior`
    estimate from earlier windows a third window must confirm it: the encoder may have slipped in between.
    """
    contact = here.last()
    if before is None or not before.time < contact.time:
        return Pair(contact)
    if before.side == here.side:
        return Pair(replace(contact, gap=before.gap, gap_std=before.gap_std))
    moved = (here.begin.position - before.position) / here.gain
    gap = before.side * (before.motor + moved - here.begin.motor)
    std = _spread(here, before, moved)
    contact = replace(contact, gap=gap, gap_std=std)
    possible = NORMAL_95 * here.fitted.settings.gap_rate * (contact.time - before.time)
    if reason := _against(here, gap, std, possible):
        return Pair(contact, reason=reason)
    growth = gap - before.gap, math.hypot(std, before.gap_std)
    if isinstance(prior, GapEstimate):
        growth = 0.0, possible / NORMAL_95
    elif not -_AGREE * growth[1] <= growth[0] <= possible + _AGREE * growth[1]:
        return Pair(contact, reason=_unconfirmed(gap, before.gap))
    return Pair(contact, replace(_stated(here, before, gap, std, growth), contact=contact))


def _spread(here: OneContact, before: LastContact, moved: float) -> float:
    """Standard deviation of the gap between two contacts, rad; `moved`: the screw's way in between, rad."""
    learnt = here.fitted.learnt
    assert learnt is not None
    pitch = math.sqrt(learnt.problem.prior.covariance[PITCH, PITCH])
    level = here.begin.std / here.gain
    return math.hypot(here.way_std + level, before.std, here.rounded, pitch * moved)


def _against(here: OneContact, gap: float, std: float, possible: float) -> str:
    """Reason against the gap (rad) between two contacts, for a `possible` growth between them (rad); empty: none."""
    settings = here.fitted.settings
    widest = std * here.fitted.evidence.caution
    if not widest <= settings.largest_std:
        return f"two contacts show the gap to {_deg(widest)} only, and {_deg(settings.largest_std)} are allowed"
    # Half of the growth is on the side of the contact before, and the motor follows it.
    if not here.way <= gap + _AGREE * std + 0.5 * possible:
        return f"the motor leads the screw by {_deg(here.way)}, more than the {_deg(gap)} between two contacts"
    if (shifted := here.shifted()) > settings.largest_shift:
        return f"with the model free the contact would move by {_deg(shifted)} more than its spread"
    return ""


def _unconfirmed(gap: float, before: float) -> str:
    if math.isnan(before):
        return f"two contacts show a gap of {_deg(gap)}: another window must confirm it"
    return f"two contacts show a gap of {_deg(gap)}, the two before {_deg(before)}"


def _stated(here: OneContact, before: LastContact, gap: float, std: float, growth: tuple[float, float]) -> GapEstimate:
    """Make the estimate of a gap (rad) with its standard deviation (rad).

    `growth`: of the gap between both contacts with its standard deviation, rad. What looks like growth may be a sensor
    that drifts to and fro, and is part of the spread.
    """
    fitted, (grown, spread) = here.fitted, growth
    learnt, settings = fitted.learnt, fitted.settings
    assert learnt is not None
    std = math.hypot(std, 0.5 * grown)
    total = math.hypot(std, settings.model_error, here.doubt())
    # The middle of both contacts, as if they were of one moment.
    levels = (before.position + here.begin.position) / here.gain - before.motor - here.begin.motor
    offset = OffsetReading(0.5 * levels + 0.25 * here.side * grown, math.hypot(0.5 * total, 0.25 * spread))
    return replace(
        fitted.blank,
        gap=gap,
        std=std,
        std_total=total,
        interval=interval_95(gap, total),
        status=GapStatus.OK,
        time=0.5 * (before.time + fitted.window.mid_time),
        theta_d0=here.begin.motor - 0.5 * here.side * gap,
        rms=fitted.rms(),
        evaluations=_fit_of(fitted).evaluations,
        offset=offset,
        machine=learnt.reading_of_either(here.single.point, settings.calibration),
    )


def _same_way(point: Point, gap: float, side: float) -> float:
    """Place in a gap (rad) from which the motor has the same way to the contact on a side as at a point."""
    return side * min(max(point.gap / gap * (1.0 + side * point.place) - 1.0, -1.0), 1.0)


def _fit_of(fitted: WindowFit) -> WhitenedFit:
    assert fitted.aligned is not None
    return fitted.aligned.whitened


def _touches(fitted: WindowFit, single: Point, side: float) -> tuple[_Touch, _Touch]:
    """Contacts on a side with the screw where the window begins and where it ends, for the point of one contact."""
    aligned, result = fitted.aligned, _fit_of(fitted)
    assert aligned is not None
    reduction, gain = result.reduction, result.reduction.response.static_gain
    excess = 0.0 if reduction.growth is None else float(result.shares[len(reduction.fixed())])
    # With the fit's own gap the motor may reach the other side so late that the last mass cannot have answered.
    traced = reduction.traced(single)
    screw = traced[SCREW] + excess * traced[BY_RATE]
    touched = int(np.argmax(traced[BY_START] == 0.0)) - 0.5 * (screw.size - 1)
    half = 0.5 * (single.gap + (reduction.rate + excess) * touched)
    # Both channels are counted from their first samples.
    level = float(fitted.window.position[max(aligned.shift, 0)] + result.shares[0])
    begins = level + gain * 0.5 * result.point.gap * result.point.place
    ends = begins + gain * float(screw[-1] - screw[0])
    furthest = side * float(np.max(side * reduction.theta_m))
    solved = least_squares(result.rows[PLACE:], result.rows[RESIDUAL])
    scale = fitted.settings.calibration * math.sqrt(max(1.0, result.variance))
    weights = np.zeros(len(result.rows) - PLACE)
    weights[CONSTANT - PLACE] = 1.0
    end_std = scale * solved.deviation(weights)
    weights[0] = 0.5 * gain * result.point.gap
    begin = _Touch(aligned.first + float(screw[0]) + side * half, begins, scale * solved.deviation(weights))
    return begin, _Touch(aligned.first + furthest, ends, end_std)


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.3g} deg"
