"""The gap of a free shaft from two windows of one flank each, on opposite sides, as damped loops make of steps.

Both encoders count absolutely within a boot. Each window tells the place of its flank over the motor's angle, and the
gap is the way between the two flanks at one angle, near which the load was in both windows: there the ratio's error
matters least. A third window must confirm it, because an encoder may have slipped in between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from servotwin.estimation.estimate import NORMAL_95, GapBetween, GapEstimate, GapStatus, LastContact, interval_95
from servotwin.estimation.output_error.flank import FlankPlace, OneFlank
from servotwin.estimation.output_error.held_chain import lever
from servotwin.estimation.output_error.models import RATIO
from servotwin.estimation.output_error.verdict import largest_std
from servotwin.estimation.two_contacts import (
    AGREE,
    LEAST_PITCH,
    VAGUE,
    WITHIN,
    confirmed_gap,
    deg,
    followed,
    unconfirmed,
)
from servotwin.estimation.window import Window


def with_contact(alone: GapEstimate, here: OneFlank, before: LastContact | None, window: Window) -> GapEstimate:
    """The estimate of a window of one flank with its contact, or that of the gap between it and the one before."""
    return _Pairing(alone, here, window).with_contact(before)


@dataclass(frozen=True, eq=False)
class _Pairing:
    """A window of one flank, with the estimate of it alone."""

    alone: GapEstimate
    here: OneFlank
    window: Window

    @property
    def _lever(self) -> float:
        return lever(self.here.axis)

    @property
    def _time(self) -> float:
        return self.window.start + self.here.time

    def with_contact(self, before: LastContact | None) -> GapEstimate:
        """As `with_contact`."""
        last = self._contact(self.here.at(float(self.here.drive[-1])))
        if before is None or not before.time < self._time:
            return replace(self.alone, contact=last)
        if before.side == last.side:
            return replace(self.alone, contact=replace(last, between=before.between))
        return self._after(before, last)

    def _contact(self, flank: FlankPlace) -> LastContact:
        std, lead = flank.std / self._lever, flank.lead / self._lever
        return LastContact(self.here.side, flank.at / self._lever, flank.place, std, self._time, lead=lead)

    def _after(self, before: LastContact, last: LastContact) -> GapEstimate:
        """The estimate with a contact on the other side before."""
        drive = self.here.drive
        at = self._lever * before.motor
        flank = self.here.at(float(np.clip(at, drive.min(), drive.max())))
        between = followed(self._between(before, flank, flank.at - at), before.between)
        allowed = self._allowed(between)
        vague = between.std > VAGUE * allowed
        contact = replace(last, between=before.between if vague else between)
        possible = self.here.settings.gap_rate * NORMAL_95 * (self._time - before.time)
        reason = self._against(between, flank, before.lead, allowed, possible)
        reason = reason or unconfirmed(between, before.between, possible)
        if reason or before.between is None:
            return replace(self.alone, contact=contact, reasons=(*self.alone.reasons, reason))
        made = self._stated(between, before.between)
        if made.std_total > allowed:
            reason = f"two contacts show the gap to {deg(made.std_total)} only, and {deg(allowed)} are allowed"
            return replace(self.alone, contact=contact, reasons=(*self.alone.reasons, reason))
        return replace(made, contact=contact)

    def _between(self, before: LastContact, flank: FlankPlace, moved: float) -> GapBetween:
        """The gap between both contacts; `moved`: the motor's way at the load between the angles, m or rad."""
        ratio = math.exp(float(flank.search.best.values[RATIO]))
        gap = before.side * (flank.place - before.position - ratio * moved) / (ratio * self._lever)
        pitch = max(LEAST_PITCH, self.here.found.problem.model.unknowns[RATIO].std)
        # What is known of friction and stiffness moves both flanks.
        std = math.hypot(flank.std / self._lever + before.std, pitch * moved / self._lever)
        return GapBetween(gap, std, 0.5 * (before.time + self._time))

    def _allowed(self, between: GapBetween) -> float:
        """Largest standard deviation of the gap, rad."""
        half = 0.5 * self._lever * max(0.0, between.gap)
        return 2.0 * largest_std(self.here.found, half, self.here.settings) / self._lever

    def _against(self, between: GapBetween, flank: FlankPlace, lead: float, allowed: float, possible: float) -> str:
        """Reason against the gap between two contacts; empty: none. `lead`: of the motor in the window before, rad."""
        gap, least = between.gap, -AGREE * between.std
        if not between.std <= allowed:
            return f"two contacts show the gap to {deg(between.std)} only, and {deg(allowed)} are allowed"
        ahead = max(flank.lead / self._lever - 0.5 * possible, lead)
        if not gap >= max(ahead, 0.0) + least:
            return f"the motor leads the load by {deg(ahead)}, more than the {deg(gap)} between two contacts"
        return ""

    def _stated(self, now: GapBetween, earlier: GapBetween) -> GapEstimate:
        """Make the estimate of the gap between two contacts."""
        settings = self.here.settings
        gap, spread = confirmed_gap(now, earlier, self.alone.time, settings.gap_rate)
        std, gap = math.hypot(spread, WITHIN * settings.gap_rate * self.window.duration), max(0.0, gap)
        total = math.hypot(std, settings.model_share * gap)
        return replace(
            self.alone,
            gap=gap,
            std=std,
            std_total=total,
            interval=interval_95(gap, total),
            status=GapStatus.OK,
            reasons=(),
            ratio=None,
        )
