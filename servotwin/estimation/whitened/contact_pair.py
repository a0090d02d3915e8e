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
from servotwin.estimation.estimate import (
    NORMAL_95,
    GapBetween,
    GapEstimate,
    GapStatus,
    LastContact,
    OffsetReading,
    interval_95,
)
from servotwin.estimation.two_contacts import (
    AGREE,
    LEAST_PITCH,
    VAGUE,
    WITHIN,
    confirmed_gap,
    deg,
    fallen,
    followed,
    renewed,
    unconfirmed,
)
from servotwin.estimation.whitened.doubt import way_doubt
from servotwin.estimation.whitened.estimator import WindowFit
from servotwin.estimation.whitened.fit import WhitenedFit
from servotwin.estimation.whitened.free_model import PITCH, SCREW_SPREAD, FactorPrior, FreeFit
from servotwin.estimation.whitened.gate import misfits, sure_of_contact, with_free_model
from servotwin.estimation.whitened.learning import LearntFit, as_known
from servotwin.estimation.whitened.nearby import own_softness
from servotwin.estimation.whitened.reduction import CONSTANT, PLACE, RESIDUAL, Point
from servotwin.estimation.whitened.shift import fastest
from servotwin.plant.servo import Servo

_ROUNDED = math.sqrt(1.0 / 12.0)  # of a count, at each contact


@dataclass(frozen=True)
class _Touch:
    """The motor's angle at which it touches the screw (rad), when it is there (s), the last mass at rest with the screw
    there (m), and the latter's standard deviation (m)."""

    motor: float
    time: float
    position: float
    std: float


@dataclass(frozen=True, eq=False)
class OneContact:
    """A window in which the motor pushed the screw one way only.

    Attributes
    ----------
    fitted : WindowFit
    learnt : LearntFit
        The same with the machine's numbers free.
    side : float
        As of `LastContact`.
    single : FreeFit
        Fit of one contact in the widest gap, with the machine free within what is known of it.
    begin, end : _Touch
        On this side, with the screw where it was at first and at last.
    apart : float
        rad, between the way to the contact of `single` and that of `fitted`, whose level the positions are.
    """

    fitted: WindowFit
    learnt: LearntFit
    side: float
    single: FreeFit
    begin: _Touch
    end: _Touch
    apart: float

    @classmethod
    def of(cls, fitted: WindowFit, servo: Servo, machine: FactorPrior | None) -> OneContact | None:
        """Read the contact from a fit to a servo; None where the window has none for certain, or two.

        None too where the model is taken as exact: without `machine`.
        """
        aligned, settings = fitted.aligned, fitted.settings
        if machine is None or aligned is None or not fitted.one_sided():
            return None
        motion, facts = fitted.facts.travel, fitted.facts
        if max(motion.forwards, motion.backwards) < facts.needed:
            return None
        if misfits(facts, settings) or not sure_of_contact(facts, settings):
            return None
        learnt = fitted.learnt or as_known(aligned, servo, machine)
        side = 1.0 if motion.forwards > motion.backwards else -1.0
        single = learnt.one_contact(_same_way(aligned.whitened.point, aligned.largest, side))
        if single is None or learnt.beyond:
            return None
        return cls(fitted, learnt, side, single, *_touches(fitted, single.point, side))

    @property
    def way(self) -> float:
        """Motor's way to the contact, rad."""
        return self.side * (self.begin.motor - self.learnt.aligned.first)

    @cached_property
    def _beside(self) -> FreeFit:
        """The fit, or, where it begins so close to the contact that free motions hide it, the point a little off."""
        settings = self.fitted.settings
        if math.isfinite(self.single.covariance[1, 1]) and abs(self.single.point.place) < 1.0:
            return self.single
        gap, place = self.single.point
        place += self.side * 2.0 * settings.largest_std / gap
        start = np.array([gap, place, *self.single.factors])
        return self.learnt.problem.descend(start, (False, True), evaluations=1)

    @property
    def way_std(self) -> float:
        """Standard deviation of the motor's way to the contact, rad."""
        scale = self.learnt.scale(self.fitted.settings.calibration)
        return 0.5 * self.single.point.gap * math.sqrt(scale * self._beside.covariance[1, 1])

    @property
    def gain(self) -> float:
        """Position over the screw's angle at rest, m/rad."""
        return _fit_of(self.fitted).reduction.response.static_gain

    @property
    def rounded(self) -> float:
        """Standard deviation (rad) of one contact by the counts of both channels."""
        facts, stated = self.fitted.facts, self.fitted.servo.position_resolution
        return _ROUNDED * math.hypot(facts.count, max(facts.scale, stated / abs(self.gain)))

    def last(self) -> LastContact:
        """The contact for later windows."""
        std = math.hypot(self.end.std / self.gain, self.rounded)
        lead = max(0.0, self.way - self.apart - NORMAL_95 * self.way_std)
        return LastContact(self.side, self.end.motor, self.end.position, std, self.end.time, lead=lead)

    def shifted(self) -> float:
        """Change of the motor's way to the contact (rad) with the model free within its usual error, as far as the
        window tells the free model's."""
        start, aligned = self.single, self.learnt.aligned
        free = with_free_model(aligned, self.learnt.servo)
        other = free.descend(np.array([*start.point, *np.zeros(start.factors.size)]), (False, True))
        moved = 0.5 * start.point.gap * abs(other.point.place - start.point.place)
        variance = max(1.0, aligned.whitened.variance)
        return max(0.0, moved - NORMAL_95 * 0.5 * start.point.gap * math.sqrt(variance * other.covariance[1, 1]))

    def doubt(self) -> float:
        """Root mean square (rad) of what machines and sensors that are not as assumed can do to the way."""
        aligned = self.learnt.aligned
        at = np.array([*self._beside.point, *self._beside.factors])
        ramp = fastest(aligned.whitened.reduction, self.fitted.second)
        return math.hypot(
            way_doubt(self.learnt.problem, at, max(1.0, aligned.whitened.variance), aligned.delay, ramp),
            self.learnt.way_moved(at, self.fitted.settings.calibration),
        )


@dataclass(frozen=True, eq=False)
class Pair:
    """The contact of a window, and the gap between it and the contact before, if that is on the other side.

    Attributes
    ----------
    here : OneContact
    contact : LastContact
        For later windows, with the gap.
    before : LastContact or None
        None: there is no contact on the other side yet.
    between : GapBetween or None
        None without `before`.
    """

    here: OneContact
    contact: LastContact
    before: LastContact | None = None
    between: GapBetween | None = None

    @cached_property
    def reason(self) -> str:
        """Reason for which the contacts show no gap, or not yet; empty: they do, or there is one contact only."""
        if self.before is None or self.between is None:
            return ""
        possible = NORMAL_95 * self.here.fitted.settings.gap_rate * (self.here.begin.time - self.before.time)
        against = _against(self.here, self.between, self.before.lead, possible)
        return against or unconfirmed(self.between, self.before.between, possible)

    @property
    def estimate(self) -> GapEstimate | None:
        """Estimate of the gap by both contacts; None: they show none."""
        if self.before is None or self.between is None or self.reason:
            return None
        assert self.before.between is not None
        made = _stated(self.here, self.before, self.between, self.before.between)
        return replace(made, contact=replace(self.contact, jumps=0))

    def agrees(self, other: GapEstimate) -> bool:
        """True where the contacts do not contradict another estimate of the same window.

        Where two contacts before have not shown the growth, the one that is assumed counts. A gap that has fallen, or a
        contact that has jumped, is no growth: the encoder may have slipped, and its offset be another, until two
        contacts confirm each other.
        """
        seen, earlier = self.between, None if self.before is None else self.before.between
        if self.contact.jumps > 0 or (seen is not None and earlier is not None and fallen(seen, earlier)):
            return False
        if seen is None:
            return True
        elapsed, spread = other.time - seen.time, AGREE * math.hypot(other.std_total, seen.std)
        if math.isnan(seen.rate):
            return abs(other.gap - seen.gap) <= spread + NORMAL_95 * self.here.fitted.settings.gap_rate * elapsed
        # What shrinks does not go on shrinking.
        grows = max(0.0, seen.rate)
        bend = 0.0 if earlier is None or math.isnan(earlier.rate) else abs(grows - max(0.0, earlier.rate))
        return abs(other.gap - seen.gap - grows * elapsed) <= spread + bend * elapsed

    def added_to(self, alone: GapEstimate) -> GapEstimate:
        """Another estimate of the later window, with the contact and, where it is not OK, the reason."""
        reasons = () if alone.ok else filter(None, (self.reason,))
        return replace(alone, contact=self.contact, reasons=(*alone.reasons, *reasons))


def pair(here: OneContact, before: LastContact | None) -> Pair:
    """Find the gap between a window of one contact and the last contact of an earlier one on the other side.

    It belongs to the middle between both contacts, because half of it is that of each. The contacts of a third window
    must confirm it: the encoder may have slipped in between. So must contacts on the same side, where they come first.
    """
    contact = here.last()
    if before is None or not before.time < here.begin.time:
        return Pair(here, contact)
    if before.side == here.side:
        ahead, spread = _ahead(here, contact, before)
        grown = NORMAL_95 * here.fitted.settings.gap_rate * (contact.time - before.time)
        return Pair(here, renewed(contact, before, ahead, spread, grown))
    moved = (here.begin.position - before.position) / here.gain
    gap, std = before.side * (before.motor + moved - here.begin.motor), _spread(here, before, moved)
    between = followed(GapBetween(gap, std, 0.5 * (before.time + here.begin.time)), before.between)
    # What is known so badly confirms no other gap.
    vague = std > VAGUE * here.fitted.settings.of_gap(gap).largest_std
    last = replace(contact, between=before.between if vague else between, jumps=before.jumps)
    return Pair(here, last, before, between)


def _ahead(here: OneContact, contact: LastContact, before: LastContact) -> tuple[float, float]:
    """Way (rad) of the motor from the contact before to this one, outwards, less the screw's; its standard deviation.

    With the screw where it was at last or at first, whichever is nearer to where it was before.
    """
    at_last, at_first = ((touch.position - before.position) / here.gain for touch in (here.end, here.begin))
    if abs(at_last) <= abs(at_first):
        std = math.hypot(contact.std, before.std, _pitch_std(here) * at_last)
        return here.side * (here.end.motor - before.motor - at_last), std
    return here.side * (here.begin.motor - before.motor - at_first), _spread(here, before, at_first)


def _spread(here: OneContact, before: LastContact, moved: float) -> float:
    """Standard deviation of the gap between two contacts, rad; `moved`: the screw's way in between, rad."""
    way, level = here.way_std, here.begin.std / here.gain
    unsure = max(0.0, here.apart - NORMAL_95 * way)
    return math.hypot(way + level, unsure, before.std, here.rounded, _pitch_std(here) * moved)


def _pitch_std(here: OneContact) -> float:
    """Relative standard deviation of the pitch; a softer screw takes more of the travel."""
    problem = here.learnt.problem
    return max(
        LEAST_PITCH, math.sqrt(problem.prior.covariance[PITCH, PITCH]), SCREW_SPREAD * own_softness(problem.servo)
    )


def _against(here: OneContact, between: GapBetween, lead: float, possible: float) -> str:
    """Reason against the gap between two contacts, for a `possible` growth between them (rad); empty: none.

    `lead`: of the motor in the window before, rad.
    """
    settings = here.fitted.settings.of_gap(between.gap)
    gap, least, widest = between.gap, -AGREE * between.std, between.std * here.fitted.facts.caution
    if not widest <= settings.largest_std:
        return f"two contacts show the gap to {deg(widest)} only, and {deg(settings.largest_std)} are allowed"
    # Half of the growth is on the side of the contact before, and the motor follows it.
    if not gap >= max(here.way - 0.5 * possible, lead, 0.0) + least:
        ahead = max(here.way, lead)
        return f"the motor leads the screw by {deg(ahead)}, more than the {deg(gap)} between two contacts"
    if (shifted := here.shifted()) > settings.largest_shift:
        return f"with the model free the contact would move by {deg(shifted)} more than its spread"
    return ""


def _stated(here: OneContact, before: LastContact, now: GapBetween, earlier: GapBetween) -> GapEstimate:
    """Make the estimate of the gap between two contacts."""
    fitted, settings = here.fitted, here.fitted.settings
    later, spread = confirmed_gap(now, earlier, fitted.blank.time, settings.gap_rate)
    std = math.hypot(spread, WITHIN * settings.gap_rate * fitted.window.duration)
    total = math.hypot(std, settings.model_error, here.doubt())
    # The middle of both contacts, as if they were of one moment.
    levels = (before.position + here.begin.position) / here.gain - before.motor - here.begin.motor
    grown = now.rate * (here.begin.time - before.time)
    offset_std = math.hypot(0.5 * total, 0.25 * math.hypot(now.std, earlier.std))
    gap = max(0.0, later)
    return replace(
        fitted.blank,
        gap=gap,
        std=std,
        std_total=total,
        interval=interval_95(gap, total),
        status=GapStatus.OK,
        theta_d0=here.begin.motor - 0.5 * here.side * gap,
        rms=fitted.rms(),
        evaluations=_fit_of(fitted).evaluations,
        offset=OffsetReading(0.5 * levels + 0.25 * here.side * grown, offset_std),
        machine=here.learnt.reading_of_either(here.single.point, settings.calibration),
    )


def _same_way(point: Point, gap: float, side: float) -> float:
    """Place in a gap (rad) from which the motor has the same way to the contact on a side as at a point."""
    return side * min(max(point.gap / gap * (1.0 + side * point.place) - 1.0, -1.0), 1.0)


def _fit_of(fitted: WindowFit) -> WhitenedFit:
    assert fitted.aligned is not None
    return fitted.aligned.whitened


def _touches(fitted: WindowFit, single: Point, side: float) -> tuple[_Touch, _Touch, float]:
    """`begin`, `end` and `apart` of a `OneContact`, for the point of one contact."""
    aligned, result, window = fitted.aligned, _fit_of(fitted), fitted.window
    assert aligned is not None
    reduction, gain = result.reduction, result.reduction.response.static_gain
    excess = 0.0 if reduction.growth is None else float(result.shares[len(reduction.fixed())])
    # With the fit's own gap the motor may reach the other side so late that the last mass cannot have answered.
    traced = reduction.traced(single)
    screw = traced[SCREW] + excess * traced[BY_RATE]
    touched, furthest = int(np.argmax(traced[BY_START] == 0.0)), int(np.argmax(side * reduction.theta_m))
    grown = (reduction.rate + excess) * (touched - 0.5 * (screw.size - 1))
    at = float(screw[0]) + side * 0.5 * (single.gap + grown)
    # The constant belongs to the fit's own way to the contact: a motion at first may hide some of it, and a short push
    # the other way may come before.
    fits = reduction.traced(result.point)
    own = fits[SCREW] + excess * fits[BY_RATE]
    apart = abs(float(own[0]) + side * 0.5 * (result.point.gap + grown) - at)
    # Both channels are counted from their first samples.
    level = float(window.position[max(aligned.shift, 0)] + result.shares[0])
    begin, end = _level_stds(fitted, result)
    first = window.start + max(-aligned.shift, 0) / window.sample_rate

    def touch(angle: float, sample: int, position: float, std: float) -> _Touch:
        return _Touch(aligned.first + float(angle), first + sample / window.sample_rate, position, std)

    return (
        touch(at, touched, level + gain * float(own[0]), begin),
        touch(reduction.theta_m[furthest], furthest, level + gain * side * float(np.max(side * own)), end),
        apart,
    )


def _level_stds(fitted: WindowFit, result: WhitenedFit) -> tuple[float, float]:
    """Standard deviations (m) of the last mass's place at rest, with the screw where it was at first and at last."""
    solved = least_squares(result.rows[PLACE:], result.rows[RESIDUAL])
    scale = fitted.settings.calibration * math.sqrt(max(1.0, result.variance))
    weights = np.zeros(len(result.rows) - PLACE)
    weights[CONSTANT - PLACE] = 1.0
    last = scale * solved.deviation(weights)
    weights[0] = 0.5 * result.reduction.response.static_gain * result.point.gap
    return scale * solved.deviation(weights), last
