"""Confirmation of a gap that the contacts of two windows show, one on each side, by the contacts before."""

from __future__ import annotations

import math
from dataclasses import replace

from servotwin.estimation.estimate import GapBetween, LastContact

AGREE = 3.0  # standard deviations by which the gaps of two pairs may differ
SUDDEN = 0.6  # standard deviations per growth that was not there before: its whole size is then within the interval
VAGUE = 2.0  # times the largest standard deviation of an estimate: a pair that knows its gap so badly confirms none
WITHIN = 0.25  # standard deviations per growth within a window, which its one contact hardly tells from the way to it
LEAST_PITCH = (
    0.002  # least standard deviation of the pitch: noise and cyclic errors of the angle bend it beyond its own
)


def renewed(last: LastContact, before: LastContact, ahead: float, std: float, possible: float) -> LastContact:
    """The last contact with what the one before, on the same side, knew of the gap.

    Half of what a gap grows is on either side. A contact that is elsewhere is no wear: an encoder has slipped, or
    another machine has the name. The contacts before then confirm nothing.

    Parameters
    ----------
    last, before : LastContact
    ahead, std : float
        rad, way of the motor from the contact before to this one, outwards, and its standard deviation.
    possible : float
        rad, growth of the gap in between.
    """
    between = before.between
    spread = AGREE * (std if between is None else math.hypot(std, between.std))
    if not -spread <= ahead <= 0.5 * possible + spread:
        return replace(last, between=None, jumps=before.jumps + 1)
    if between is not None and ahead > spread:
        middle = between.time + 0.5 * (last.time - before.time)
        between = replace(between, gap=between.gap + ahead, std=math.hypot(between.std, std), time=middle)
    return replace(last, between=between, jumps=before.jumps)


def followed(now: GapBetween, earlier: GapBetween | None) -> GapBetween:
    """The gap with its growth since an earlier one."""
    if earlier is None or not now.time > earlier.time:
        return now
    return replace(now, rate=(now.gap - earlier.gap) / (now.time - earlier.time))


def fallen(now: GapBetween, earlier: GapBetween) -> bool:
    """True where a gap is surely narrower than an earlier one."""
    return now.gap - earlier.gap < -AGREE * math.hypot(now.std, earlier.std)


def unconfirmed(now: GapBetween, earlier: GapBetween | None, possible: float) -> str:
    """Reason for which the two contacts before do not confirm a gap that may have grown (rad); empty: they do."""
    if earlier is None:
        return f"two contacts show a gap of {deg(now.gap)}: another window must confirm it"
    spread = AGREE * math.hypot(now.std, earlier.std)
    if not fallen(now, earlier) and now.gap - earlier.gap <= possible + spread:
        return ""
    return f"two contacts show a gap of {deg(now.gap)}, the two before {deg(earlier.gap)}"


def confirmed_gap(now: GapBetween, earlier: GapBetween, time: float, gap_rate: float) -> tuple[float, float]:
    """Gap at a later time (s) and its standard deviation, rad, with its growth since the gap that confirms it.

    Half of what grew since the contact before is missing in the gap between both: it goes on growing as far as both
    gaps tell the growth, with `gap_rate` (rad/s) expected. An encoder that slips, or a position that drifts to and fro,
    looks like growth once.
    """
    elapsed, later, grown = now.time - earlier.time, time - now.time, now.gap - earlier.gap
    expected, noise = (gap_rate * elapsed) ** 2, now.std**2 + earlier.std**2
    told = expected / (expected + noise) if expected > 0.0 else 0.0
    ahead = told * later / elapsed
    steady = 0.0 if math.isnan(earlier.rate) else max(0.0, earlier.rate) * elapsed
    return now.gap + ahead * grown, math.hypot(
        (1.0 + ahead) * now.std,
        ahead * earlier.std,
        (1.0 - told) * gap_rate * later,
        SUDDEN * math.hypot(grown - steady, earlier.std),
    )


def deg(angle: float) -> str:
    """An angle (rad) in words."""
    return f"{math.degrees(angle):.3g} deg"
