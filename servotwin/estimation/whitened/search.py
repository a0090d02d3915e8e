"""Bounded searches in gap and screw place: descent, several starts, ways off plateaus."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.contacts import BY_GAP, BY_START, contacts
from servotwin.estimation.whitened.descent import SearchLimits, descend_from
from servotwin.estimation.whitened.reduction import Misfit, MisfitSlopes, Point
from servotwin.plant.signals import Array

_SHORT = 20  # steps of a descent that only looks whether there is something lower
_GAIN = 1e-8
_ROUGH = 1e-6  # of the cost: a gain that decides between minima, not where one lies; some valleys are long and flat


class Free(NamedTuple):
    """Coordinates that a search may change."""

    gap: bool
    place: bool


_BOTH, GAP_ONLY, PLACE_ONLY = Free(True, True), Free(True, False), Free(False, True)
_ROUND = tuple(0.1 * step for step in range(-9, 10))
_LOWER = 1e-3  # of the cost: how much another place must promise
_PLAIN = 1e-4  # of the information: below it gap and place are not told apart
PLACES, _WITHIN, _BEYOND = (-1.0, -0.75, -0.4, 0.0, 0.4, 0.75, 1.0), (0.97, 0.85), (0.002, 0.01, 0.03, 0.08, 0.2)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """End of a search."""

    point: Point
    slopes: MisfitSlopes
    evaluations: int
    converged: bool


def descend(
    misfit: Misfit,
    start: Point,
    largest: float,
    tolerance: float,
    steps: int = 60,
    free: Free = _BOTH,
    gain: float = _GAIN,
) -> SearchResult:
    """Descend from a start to the nearest minimum with 0 <= gap <= largest (rad).

    It ends when a step moves the gap, and the screw's start, by less than `tolerance` (rad), or promises less than the
    part `gain` of the cost. What is not `free` keeps its value.
    """
    rows = np.empty((3, misfit.position.size))
    # Plain numbers: a compiled version is made for every other combination of types.
    limits = SearchLimits(float(largest), float(tolerance), steps, gain, (free.gap, free.place))
    end = descend_from(misfit.data, misfit.room, float(start.gap), float(start.place), limits, rows)
    slopes = MisfitSlopes(rows[0], rows[1:], end.cost)
    return SearchResult(Point(end.gap, end.place), slopes, end.evaluations, end.converged)


def search(misfit: Misfit, gaps: Sequence[float], largest: float, tolerance: float) -> list[SearchResult]:
    """Minima from several starts: for every place of the screw the best of some gaps (rad).

    First the gap alone descends. From where the screw rests for long, gap and place move it alike, and nothing leads
    back to where it does not rest: the place must not go there early.
    """
    costs = misfit.costs([Point(gap, place) for place in PLACES for gap in gaps]).reshape(len(PLACES), -1)
    best = [Point(gaps[lowest], place) for place, lowest in zip(PLACES, np.argmin(costs, axis=1), strict=True)]
    near = [descend(misfit, point, largest, tolerance, 12, GAP_ONLY, _ROUGH) for point in best]
    return [continued(misfit, fit, largest, tolerance) for fit in near]


def continued(misfit: Misfit, fit: SearchResult, largest: float, tolerance: float) -> SearchResult:
    """Continue in gap and place; also from inside, if the screw began in contact, or from contact, if close to it.

    In contact its place has no derivative, because the contact undoes it at once; that says nothing of a little further
    in. And from a little further in, where the motor only just began to move, next to nothing leads there.
    """
    ends = [descend(misfit, fit.point, largest, tolerance, gain=_ROUGH)]
    point = ends[0].point
    inside = [point._replace(place=share * point.place) for share in _WITHIN] if abs(point.place) == 1.0 else []
    ends += [descend(misfit, start, largest, tolerance, _SHORT, gain=_ROUGH) for start in (*inside, *in_contact(point))]
    best = min(ends, key=lambda end: end.slopes.cost)
    evaluations = fit.evaluations + sum(end.evaluations for end in ends)
    return SearchResult(best.point, best.slopes, evaluations, best.converged)


def in_contact(point: Point) -> list[Point]:
    """The point with the screw in the contact that it is close to, if it is and does not begin there."""
    return [point._replace(place=math.copysign(1.0, point.place))] if _WITHIN[-1] <= abs(point.place) < 1.0 else []


def off_the_plateau(misfit: Misfit, fit: SearchResult, largest: float, tolerance: float) -> SearchResult:
    """A fit, or a lower one from the lowest of other places in the same gap.

    A contact in the first moments of a window looks like motion from before it: over much of the gap the place makes no
    difference, nothing leads away from there, and a place that makes one may lie beyond.
    """
    points = [fit.point._replace(place=place) for place in _ROUND]
    costs = misfit.costs(points)
    lowest = int(np.argmin(costs))
    if not costs[lowest] < (1.0 - _LOWER) * fit.slopes.cost:
        return fit
    other = descend(misfit, points[lowest], largest, tolerance, gain=_ROUGH)
    best = min(fit, other, key=lambda one: one.slopes.cost)
    return SearchResult(best.point, best.slopes, fit.evaluations + other.evaluations, best.converged)


def off_the_plain(misfit: Misfit, fit: SearchResult, largest: float, tolerance: float) -> SearchResult:
    """A fit, or a lower one from the edge of the plain that it lies on.

    Where the screw rests until its first contact, gap and place act alike, through the way that the motor went before.
    The plain ends where a smaller gap would let the motor touch the screw on the other side on its way; a little travel
    there, too small to be seen from afar, may lead lower.
    """
    J = fit.slopes.jacobian
    a, b, c = float(J[0] @ J[0]), float(J[0] @ J[1]), float(J[1] @ J[1])
    if a * c - b * b > _PLAIN * a * c:
        return fit
    starts = _edges(misfit.theta_m, fit.point)
    fits = [fit, *(descend(misfit, start, largest, tolerance, gain=_ROUGH) for start in starts)]
    best = min(fits, key=lambda one: one.slopes.cost)
    return SearchResult(best.point, best.slopes, sum(one.evaluations for one in fits), best.converged)


def _edges(theta_m: Array, point: Point) -> list[Point]:
    """Points a little beyond the edge of the plain on which `point` lies."""
    screw = contacts(theta_m, point.screw(0.0))
    touched = np.flatnonzero(screw[BY_START] == 0.0)
    if not touched.size:
        return []
    first = int(touched[0])
    side = 1.0 if screw[BY_GAP, first] < 0.0 else -1.0
    way = 0.5 * point.gap * (1.0 + side * point.place)
    edge = way - float(np.min(side * theta_m[: first + 1]))
    gaps = [(1.0 - share) * edge for share in _BEYOND]
    return [Point(gap, side * min(1.0, 2.0 * way / gap - 1.0)) for gap in gaps if gap > 0.0]
