"""Levenberg-Marquardt in the gap and the screw's place in it, within bounds, from several starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servotwin.identify.misfit import Misfit, Point, Slopes

_FIRST_DAMPING, _LARGEST_DAMPING, _FLOOR, _GAIN = 1e-3, 1e10, 1e-12, 1e-8
PLACES = (-1.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a search ended."""

    point: Point
    slopes: Slopes
    evaluations: int
    converged: bool


def descend(misfit: Misfit, start: Point, largest: float, tolerance: float, steps: int = 60, held: bool = False) -> Fit:
    """From a start to the nearest minimum with 0 <= gap <= largest (rad); it ends when a step moves the gap, and the
    screw's start, by less than `tolerance` (rad). With `held`, the gap stays."""
    point, here, damping = start, misfit.slopes(start), _FIRST_DAMPING
    for count in range(1, steps):
        step = _step(here, point, damping, largest, held)
        trial = _bounded(point, step, largest)
        if _distance(point, trial) <= tolerance or _promise(here, point, trial) <= _GAIN * here.cost:
            return Fit(point, here, count, True)
        ahead = misfit.slopes(trial)
        if ahead.cost < here.cost:
            point, here, damping = trial, ahead, max(0.1 * damping, 1e-9)
        else:
            damping = 8.0 * damping
            if damping > _LARGEST_DAMPING:
                return Fit(point, here, count + 1, True)
    return Fit(point, here, steps, False)


def _step(here: Slopes, point: Point, damping: float, largest: float, held: bool) -> tuple[float, float]:
    """The damped Gauss-Newton step; a coordinate at its bound that wants to leave stays."""
    J = here.jacobian
    a, b, c = float(J[0] @ J[0]), float(J[0] @ J[1]), float(J[1] @ J[1])
    g, h = -float(J[0] @ here.residual), -float(J[1] @ here.residual)
    gap_free = not held and not ((point.gap <= 0.0 and g < 0.0) or (point.gap >= largest and g > 0.0))
    place_free = not ((point.place <= -1.0 and h < 0.0) or (point.place >= 1.0 and h > 0.0)) and c > 0.0
    a, c = a * (1.0 + damping), c * (1.0 + damping)
    if gap_free and place_free and a * c - b * b > _FLOOR * a * c:
        determinant = a * c - b * b
        return (c * g - b * h) / determinant, (a * h - b * g) / determinant
    return (g / a if gap_free and a > 0.0 else 0.0), (h / c if place_free else 0.0)


def _promise(here: Slopes, point: Point, trial: Point) -> float:
    """By how much a step lowers the cost if the residual is linear."""
    change = (trial.gap - point.gap) * here.jacobian[0] + (trial.place - point.place) * here.jacobian[1]
    return -float(change @ (2.0 * here.residual + change))


def _bounded(point: Point, step: tuple[float, float], largest: float) -> Point:
    return Point(min(max(point.gap + step[0], 0.0), largest), min(max(point.place + step[1], -1.0), 1.0))


def _distance(one: Point, other: Point) -> float:
    """rad: how far two points are apart, the place counted as an angle of the screw."""
    return max(abs(one.gap - other.gap), 0.5 * other.gap * abs(one.place - other.place))


def scan(misfit: Misfit, gaps: Sequence[float], keep: int) -> list[Point]:
    """The `keep` best starts of a grid of gaps (rad) and places."""
    points = [Point(gap, place) for gap in gaps for place in PLACES]
    costs = np.array([misfit.cost(point) for point in points])
    return [points[i] for i in np.argsort(costs, kind="stable")[:keep]]
