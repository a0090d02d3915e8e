"""The residual of a window at a gap and a place, and the descent in both, compiled as one.

A search takes some hundred steps of a few microseconds each: as long as calling as many functions from Python.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.contacts import trace
from servotwin.estimation.core.least_squares import inner, remove
from servotwin.estimation.core.reduced import run_blocks
from servotwin.estimation.core.response import run_modes
from servotwin.estimation.core.whitening import whiten
from servotwin.hybrid.compiled import bare, inlined
from servotwin.plant.signals import Array

_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING, _FLOOR = 1e-3, 1e-9, 1e10, 1e-12


class MisfitData(NamedTuple):
    """Numbers of a misfit: channels, nuisances, response and noise.

    Attributes
    ----------
    theta_m : (n,) array
        rad.
    position : (M,) array
        Reduced and whitened.
    basis : (r, M) array
        Orthonormal nuisances.
    decay, gain : (modes, 2) arrays
    direct : float
        Of the response at the full rate; used where the decimation's factor is 1.
    angles, slow, share : arrays
        `BlockWeights`; empty where the factor is 1.
    predictors, spread : arrays
        Of the noise.
    rate : float
        rad per sample, growth of the gap.
    """

    theta_m: Array
    position: Array
    basis: Array
    decay: Array
    gain: Array
    direct: float
    angles: Array
    slow: Array
    share: Array
    predictors: Array
    spread: Array
    rate: float


class Room(NamedTuple):
    """Memory of an evaluation; not for two threads at once.

    Attributes
    ----------
    screw : (4, n) array
    table, sums : arrays
        Of `run_blocks`.
    moved, white : (3, m) arrays
    here, ahead : (3, M) arrays
    """

    screw: Array
    table: Array
    sums: Array
    moved: Array
    white: Array
    here: Array
    ahead: Array

    @classmethod
    def of(cls, data: MisfitData, samples: int) -> Room:
        """Make room for `samples` reduced samples (m)."""
        size, factor = data.theta_m.size, data.angles.shape[1]
        blocks = size // factor if factor else 0
        shapes = (4, size), (factor, blocks), (len(data.angles), blocks), *2 * [(3, samples)]
        return cls(*(np.empty(shape) for shape in shapes), *(np.empty((3, data.position.size)) for _ in range(2)))


@bare
def mix_places(seen: Array, gap: float, place: float) -> None:
    """Turn derivatives by gap at fixed theta_d0, and by theta_d0, into those by gap at fixed place, and by place."""
    half = 0.5 * gap
    for i in range(seen.shape[1]):
        seen[1, i] += 0.5 * place * seen[2, i]
        seen[2, i] *= half


@bare
def evaluate(data: MisfitData, room: Room, gap: float, place: float, rows: Array) -> float:
    """Residual, and where `rows` (1 or 3, M) has room for them its derivatives by gap and place; return its square."""
    count = len(rows)
    screw = room.screw[: 1 if count == 1 else 4]
    trace(data.theta_m, gap, data.theta_m[0] + 0.5 * gap * place, data.rate, screw)
    if count > 1:
        mix_places(screw, gap, place)
    moved, white = room.moved[:count], room.white[:count]
    if len(data.angles) > 0:
        run_blocks(screw[:count], data.angles, data.slow, data.share, room.table, room.sums, moved)
    else:
        for k in range(count):
            run_modes(screw[k], data.decay, data.gain, data.direct, moved[k])
    if data.spread.size == 1 and data.spread[0] == 1.0:
        white = moved
    else:
        whiten(moved, data.predictors, data.spread, white)
    for k in range(count):
        row = rows[k]
        for i in range(white.shape[1]):
            row[i] = -white[k, i]
        for i in range(white.shape[1], row.size):
            row[i] = 0.0
        if k == 0:
            for i in range(row.size):
                row[i] += data.position[i]
        remove(data.basis, len(data.basis), row)
    return inner(rows[0], rows[0])


@bare
def evaluate_all(data: MisfitData, room: Room, points: Array, costs: Array) -> None:
    """Squares (k,) of the residuals at points (k, 2)."""
    for k in range(len(points)):
        costs[k] = evaluate(data, room, points[k, 0], points[k, 1], room.here[:1])


@inlined
def step_from(
    rows: Array, gap: float, place: float, damping: float, largest: float, free: tuple[bool, bool]
) -> tuple[float, float, float]:
    """The damped Gauss-Newton step to new gap and place, and the decrease of the cost that it promises.

    A coordinate at its bound that wants to leave stays. The promise is that of a linear residual.
    """
    residual, by_gap, by_place = rows[0], rows[1], rows[2]
    a, b, c = inner(by_gap, by_gap), inner(by_gap, by_place), inner(by_place, by_place)
    g, h = -inner(by_gap, residual), -inner(by_place, residual)
    gap_free = free[0] and not ((gap <= 0.0 and g < 0.0) or (gap >= largest and g > 0.0))
    place_free = free[1] and not ((place <= -1.0 and h < 0.0) or (place >= 1.0 and h > 0.0)) and c > 0.0
    stiff, steep = a * (1.0 + damping), c * (1.0 + damping)
    determinant = stiff * steep - b * b
    # Where gap and place act alike the determinant is rounding: each then steps by itself.
    if gap_free and place_free and determinant > _FLOOR * stiff * steep:
        by, along = (steep * g - b * h) / determinant, (stiff * h - b * g) / determinant
    else:
        by = g / stiff if gap_free and stiff > 0.0 else 0.0
        along = h / steep if place_free else 0.0
    ahead, there = min(max(gap + by, 0.0), largest), min(max(place + along, -1.0), 1.0)
    by, along = ahead - gap, there - place
    return ahead, there, 2.0 * (by * g + along * h) - (by * by * a + 2.0 * by * along * b + along * along * c)


class Descent(NamedTuple):
    """End of a descent: where, with what cost, after how many evaluations, and whether at a minimum."""

    gap: float
    place: float
    cost: float
    evaluations: int
    converged: bool


class SearchLimits(NamedTuple):
    """Largest gap and tolerance (rad), most steps, least gain as part of the cost, and which of gap and place move."""

    largest: float
    tolerance: float
    steps: int
    gain: float
    free: tuple[bool, bool]


@bare
def descend_from(data: MisfitData, room: Room, gap: float, place: float, limits: SearchLimits, rows: Array) -> Descent:
    """Descend from a gap (rad) and a place by Levenberg and Marquardt's method; residual and derivatives into `rows`.

    After a success the next step is closer to Gauss-Newton, after a failure shorter and steeper.
    """
    here, ahead, damping = room.here, room.ahead, _FIRST_DAMPING
    cost = evaluate(data, room, gap, place, here)
    count, converged = 1, False
    while count < limits.steps:
        further, there, promise = step_from(here, gap, place, damping, limits.largest, limits.free)
        distance = max(abs(further - gap), 0.5 * further * abs(there - place))
        if distance <= limits.tolerance or promise <= limits.gain * cost:
            converged = True
            break
        after = evaluate(data, room, further, there, ahead)
        count += 1
        if after < cost:
            gap, place, cost, damping = further, there, after, max(0.1 * damping, _LEAST_DAMPING)
            here, ahead = ahead, here
        else:
            damping *= 8.0
            if damping > _LARGEST_DAMPING:
                converged = True
                break
    for k in range(3):
        for i in range(rows.shape[1]):
            rows[k, i] = here[k, i]
    return Descent(gap, place, cost, count, converged)
