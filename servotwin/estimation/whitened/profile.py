"""The profile-likelihood interval: every gap that the window does not contradict, whatever the screw's start."""

from __future__ import annotations

import math
from collections.abc import Callable

from servotwin.estimation.estimate import Interval
from servotwin.estimation.whitened.misfit import Point
from servotwin.estimation.whitened.passes import Found
from servotwin.estimation.whitened.search import PLACE_ONLY, PLACES, descend

_CHI_SQUARED_95 = 3.841458820694124
_CLOSE, _TRIALS = 0.1, 12
_FURTHER = 3.0  # times as far, at most, the next trial lies
_WELL_WITHIN = 1.0 / _FURTHER**2  # of what is allowed: any less makes no difference to the next trial
_NEAR = 0.1  # of the gap: closer by, the best place is next to that of the fit, if the spread is not wider


def profile_interval(found: Found, std: float, calibration: float, largest: float, tolerance: float) -> Interval:
    """95 % interval of the gap, rad; 0 or inf where the likelihood has no end on that side.

    Parameters
    ----------
    found : Found
    std : float
        rad: where to look first; inf is allowed.
    calibration : float
        Of the standard deviation.
    largest : float
        rad: gaps above this are not told from each other.
    tolerance : float
        rad, of the search for the screw's start.
    """
    allowed = _CHI_SQUARED_95 * calibration**2 * max(1.0, found.variance)

    def rise(gap: float) -> float:
        """How much worse the best fit with this gap is, in units of what is allowed; well within, how much at most."""
        near = abs(gap - found.point.gap) < min(3.0 * std, _NEAR * found.point.gap)
        places = (found.point.place,) if near else (*same_way(found.point, gap), *PLACES)
        lowest = math.inf
        for place in dict.fromkeys(places):
            fit = descend(found.misfit, Point(gap, place), largest, tolerance, 12, PLACE_ONLY)
            lowest = min(lowest, (fit.slopes.cost - found.fit.slopes.cost) / allowed)
            if lowest <= _WELL_WITHIN:
                break
        return lowest

    first = min(1.96 * std, 0.5 * largest)
    return _end(rise, found.point.gap, -first, 0.0), _end(rise, found.point.gap, first, largest)


def same_way(point: Point, gap: float) -> tuple[float, float, float]:
    """Places in another gap (rad) at a point's place, and as far from the contact ahead, and from the one behind.

    A window of one contact is explained by any gap from whose other side the motor stays away, the way to this contact
    being the same.
    """
    if gap == 0.0:
        return (point.place,) * 3
    share = point.gap / gap
    ahead, behind = share * (1.0 + point.place) - 1.0, 1.0 - share * (1.0 - point.place)
    return point.place, min(max(ahead, -1.0), 1.0), min(max(behind, -1.0), 1.0)


def _end(rise: Callable[[float], float], middle: float, step: float, limit: float) -> float:
    """Where `rise` reaches 1 on one side, between what is known to be below and above; the far limit as 0 or inf.

    When the trials do not suffice, what is known to be above.
    """
    beyond = math.inf if limit > 0.0 else 0.0
    room = abs(limit - middle)
    inside, outside, size = 0.0, math.inf, abs(step)
    for _ in range(_TRIALS):
        at_limit = size >= room
        size = min(size, room)
        level = max(0.0, rise(middle + math.copysign(size, step)))
        if abs(level - 1.0) < _CLOSE:
            break
        if level < 1.0:
            if at_limit:
                return beyond
            inside = size
        else:
            outside = size
        size *= min(max(1.0 / math.sqrt(max(level, 1e-9)), 0.2), _FURTHER)
        if not inside < size < outside:
            size = 0.5 * (inside + outside)
    else:
        size = min(outside, room)
    return middle + math.copysign(size, step)
