"""Interval of the gap from the profile of the cost: each gap with its best place."""

from __future__ import annotations

import math
from collections.abc import Callable

from servotwin.estimation.estimate import Interval
from servotwin.estimation.whitened.fit import WhitenedFit
from servotwin.estimation.whitened.free_model import same_way
from servotwin.estimation.whitened.reduction import Point
from servotwin.estimation.whitened.search import PLACE_ONLY, PLACES, descend

_CHI_SQUARED_95 = 3.841458820694124
_CLOSE, _TRIALS = 0.1, 12  # of the allowed rise, at the end of the search; most trials
_FURTHER = 3.0  # times as far, at most, the next trial lies
_WELL_WITHIN = 1.0 / _FURTHER**2  # of what is allowed: any less makes no difference to the next trial
_NEAR = 0.1  # of the gap: closer by, the best place is next to that of the fit, if the spread is not wider


def profile_interval(result: WhitenedFit, std: float, calibration: float, largest: float, tolerance: float) -> Interval:
    """95 % interval of the gap, rad; 0 or inf where the likelihood has no end on that side.

    Parameters
    ----------
    result : WhitenedFit
    std : float
        rad: first trial; inf is allowed.
    calibration : float
        Factor of the standard deviation.
    largest : float
        rad: gaps above this are not told from each other.
    tolerance : float
        rad, of the search for the screw's start.
    """
    allowed = _CHI_SQUARED_95 * calibration**2 * max(1.0, result.variance)

    def rise(gap: float) -> float:
        """Rise of the best cost with this gap, in units of what is allowed; well within, an upper bound."""
        near = abs(gap - result.point.gap) < min(3.0 * std, _NEAR * result.point.gap)
        places = (result.point.place,) if near else (*same_way(result.point, gap), *PLACES)
        lowest = math.inf
        for place in dict.fromkeys(places):
            fit = descend(result.misfit, Point(gap, place), largest, tolerance, 12, PLACE_ONLY)
            lowest = min(lowest, (fit.slopes.cost - result.fit.slopes.cost) / allowed)
            if lowest <= _WELL_WITHIN:
                break
        return lowest

    first = min(1.96 * std, 0.5 * largest)
    return _end(rise, result.point.gap, -first, 0.0), _end(rise, result.point.gap, first, largest)


def _end(rise: Callable[[float], float], middle: float, step: float, limit: float) -> float:
    """Find the gap at which `rise` reaches 1 on one side; the far limit counts as 0 or inf.

    If the trials do not suffice, the nearest point known to lie outside.
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
