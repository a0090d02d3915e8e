"""Whether the window belongs to the model: would the gap move if the model were allowed to?

Near the fit, a model that is a little off adds multiples of a few known motions to the position: those of a stiffer or
more damped structure, of another pitch or scale, of a compliant screw. Let free within wide tolerances, they take what
they can of the residual, and the gap moves with them. So does a gap that grows within the window, where it counts as
constant.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.between import polygon
from servotwin.estimation.core.contacts import BY_RATE
from servotwin.estimation.core.normal import LeastSquares, least_squares
from servotwin.estimation.core.projection import orthonormal, project_out, spread
from servotwin.estimation.core.response import Response, response
from servotwin.estimation.core.whitening import burg
from servotwin.estimation.paper.lags import LagFilter
from servotwin.estimation.paper.observer import observer
from servotwin.estimation.whitened.passes import Found
from servotwin.estimation.whitened.reduction import CONSTANT, GAP, PLACE, RESIDUAL
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_STEP = 1e-3  # relative
_STIFF = 100.0  # screw over structure: far enough for the motion to be linear in the compliance
TOLERANCES = {"stiffness": 0.1, "damping": 0.5, "pitch or position scale": 0.05, "screw compliance": 0.1}
GROWTH = math.radians(0.15)  # rad/s: the paper's wear at its fastest
_ALPHA = 40.0  # rad/s, the paper's observer


class Shift(NamedTuple):
    """By how much the gap moves (rad), the standard deviation of that, what moves it most, in words, and how much more
    likely the window becomes: twice the logarithm of the ratio, a few for a right model."""

    gap: float
    std: float
    words: str
    gain: float


def model_shift(found: Found, servo: Servo, order: int) -> Shift:
    """The gap's move when the model is free within `TOLERANCES`, in the noise that is then left.

    Whitening takes a wrong model for noise; with the model free it is seen for what it is.
    """
    model, reduction = found.reduction.response, found.reduction
    seen = polygon(reduction.theta_m, found.point.screw(0.0, reduction.rate))
    screw = seen[:1]
    here = model.respond(screw)
    motions = [(other.respond(screw) - here) / step for other, step in _neighbours(servo, 1.0 / model.interval)]
    motions.insert(2, here)
    sizes = list(TOLERANCES.values())
    if reduction.growth is None:
        motions.append(model.respond(seen[BY_RATE:]))
        sizes.append(GROWTH * model.interval)
    free = reduction.decimation.rows(np.vstack(motions)) * np.array(sizes)[:, None]
    table, size = np.vstack([reduction.table(found.point), free]), len(free)
    shares = _within_tolerance(reduction.prepared(found.noise, table, CONSTANT), size).coefficients
    noise = burg((table[RESIDUAL] - shares @ table[GAP:])[None], order).at_least(reduction.rounding)
    rows = reduction.prepared(noise, table, CONSTANT)
    solved = _within_tolerance(rows, size)
    own = spread(rows[GAP], rows[PLACE:-size])
    std = math.sqrt(max(0.0, float(solved.deviations[0]) ** 2 - own**2)) if math.isfinite(own) else math.inf
    words = _words(solved.coefficients[-size:], solved.deviations[-size:])
    gain = 2.0 * table.shape[1] * math.log(found.noise.spread[-1] / noise.spread[-1]) if noise.spread[-1] > 0.0 else 0.0
    return Shift(float(solved.coefficients[0]), std, words, gain)


def _within_tolerance(rows: Array, free: int) -> LeastSquares:
    """All coefficients, the last `free` ones expected to be 0 with standard deviation 1."""
    known = np.zeros((len(rows), free))
    known[-free:] = np.eye(free)
    columns = np.hstack([rows, known])
    return least_squares(columns[GAP:], columns[RESIDUAL])


def _words(shares: Array, deviations: Array) -> str:
    """Which direction is needed most, and by how much."""
    index = int(np.argmax(np.abs(shares) / np.maximum(deviations, 1e-9)))
    if index == len(TOLERANCES):
        return f"a gap that grows by {math.degrees(GROWTH) * shares[index]:+.2g} deg/s would explain most of it"
    name = list(TOLERANCES)[index]
    return f"a {name} off by {100.0 * TOLERANCES[name] * shares[index]:+.2g} % would explain most of it"


@lru_cache(maxsize=32)
def _neighbours(servo: Servo, sample_rate: float) -> tuple[tuple[Response, float], ...]:
    """Responses a step away from a servo's in stiffness, damping and the screw's compliance (of the structure's)."""
    stiffer = servo.replace(k=tuple((1.0 + _STEP) * servo.stiffnesses))
    damped = servo.replace(c=tuple((1.0 + _STEP) * servo.dampings))
    stiffness = float(servo.stiffnesses.max())
    soft = 1.0 / _STIFF if servo.rigid else stiffness / servo.k_d * (1.0 + _STEP)
    softer = servo.replace(k_d=stiffness / soft)
    step = soft - (0.0 if servo.rigid else stiffness / servo.k_d)
    pairs = ((stiffer, _STEP), (damped, _STEP), (softer, step))
    return tuple((response(other, sample_rate), size) for other, size in pairs)


def observer_shift(found: Found, servo: Servo) -> tuple[float, float]:
    """By how much (rad) the paper's observer form would move the gap, and the standard deviation of that.

    The observer weights the residual by denominator / (s + alpha)^N; one step of Gauss and Newton in that weight.
    """
    reduction = found.reduction
    interval = reduction.response.interval * reduction.decimation.factor
    model = observer(servo, _ALPHA)
    weight = LagFilter.sampled(model.denominator, model.order, _ALPHA, interval)
    table = reduction.table(found.point)
    rows = np.array([weight.respond(row) for row in table])
    basis = orthonormal(np.vstack([rows[PLACE:], _transients(model.order, interval, table.shape[1])]))
    left = project_out(basis, rows[[RESIDUAL, GAP]])
    information = float(left[1] @ left[1])
    if not information > 1e-12 * float(rows[GAP] @ rows[GAP]):
        return 0.0, math.inf
    direction = np.array([weight.respond(left[1][::-1])])[0][::-1] / information
    noise = found.noise.colour_back(direction)
    own = found.std
    return float(left[0] @ left[1]) / information, math.sqrt(max(0.0, float(noise @ noise) - own**2))


def _transients(order: int, interval: float, samples: int) -> Array:
    """(order, m) what the observer has not yet forgotten: t^i exp(-alpha t)."""
    time = _ALPHA * interval * np.arange(samples)
    return np.array([time**i * np.exp(-time) for i in range(order)])
