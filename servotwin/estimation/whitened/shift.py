"""Moves of the fitted gap under other models: a free one, a ramp of the gap, the paper's observer form.

Near the fit, a model that is a little off adds multiples of a few known motions to the position: those of a stiffer or
more damped structure, of another pitch or scale, of a compliant screw. Free within wide tolerances, they take what they
can of the residual, and the gap moves with them. So does a gap that grows within the window faster than is assumed.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.contacts import BY_RATE
from servotwin.estimation.core.least_squares import LeastSquares, least_squares, orthonormal, project_out, spread
from servotwin.estimation.core.reduced import ReducedResponse
from servotwin.estimation.core.variants import variants
from servotwin.estimation.core.whitening import Autoregression, burg
from servotwin.estimation.paper.observer import LagFilter, observer
from servotwin.estimation.whitened.fit import WhitenedFit
from servotwin.estimation.whitened.nearby import Neighbour, motions, own_softness
from servotwin.estimation.whitened.reduction import CONSTANT, GAP, PLACE, RESIDUAL, Reduction
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_STEP = 1e-3  # relative
_STIFF = 100.0  # screw over structure: far enough for the motion to be linear in the compliance
_TOLERANCES = {"stiffness": 0.1, "damping": 0.5, "pitch or position scale": 0.05, "screw compliance": 0.1}
_GROWTH = math.radians(0.15)  # rad/s: the paper's wear at its fastest
_RAMP = 10.0  # times what is assumed of the growth: no wear, but a gap may be opened or taken up by hand, or by heat
_ALPHA = 40.0  # rad/s, the paper's observer


class ModelShift(NamedTuple):
    """Change of the gap (rad) with the model free, its standard deviation, its main cause in words, and the gain.

    The gain is twice the logarithm of the likelihood ratio, less two for each more order of the noise.
    """

    gap: float
    std: float
    words: str
    gain: float


def model_shift(result: WhitenedFit, servo: Servo, order: int, second: float) -> ModelShift:
    """Move of the gap when the model is free within `_TOLERANCES`, in the noise that is then left.

    Whitening takes the error of a wrong model for noise; a free model takes it up itself.
    """
    model, reduction = result.reduction.reduced, result.reduction
    screw = reduction.traced(result.point)
    table, weights = result.table, result.shares[1 : len(reduction.fixed())]
    answer = reduction.position - table[RESIDUAL]
    moved = motions(model, _neighbours(servo, model), screw[:1], answer, weights)
    free = np.insert(moved, 2, answer, axis=0)
    ramp = fastest(reduction, second)
    free = np.vstack([free, model.respond(screw[BY_RATE:])])
    free *= np.array([*_TOLERANCES.values(), ramp * model.response.interval])[:, None]
    table, size = np.vstack([table, free]), len(free)
    shares = _within_tolerance(reduction.prepared(result.noise, table, CONSTANT), size).coefficients
    noise = burg((table[RESIDUAL] - shares @ table[GAP:])[None], order).at_least(reduction.rounding)
    rows = reduction.prepared(noise, table, CONSTANT)
    solved = _within_tolerance(rows, size)
    own = spread(rows[GAP], rows[PLACE:-size])
    std = math.sqrt(max(0.0, float(solved.deviations[0]) ** 2 - own**2)) if math.isfinite(own) else math.inf
    words = _words(solved.coefficients[-size:], solved.deviations[-size:], ramp)
    return ModelShift(float(solved.coefficients[0]), std, words, _likelier(result.noise, noise, table.shape[1]))


def fastest(reduction: Reduction, second: float) -> float:
    """Usual size of a ramp of the gap that nobody stated, rad/s."""
    assumed = _GROWTH / second if reduction.growth is None else reduction.growth.std / reduction.response.interval
    return _RAMP * assumed


def _likelier(noise: Autoregression, other: Autoregression, samples: int) -> float:
    """Gain of another noise over one: Akaike's, as an autoregression of higher order takes up more by itself."""
    if not other.spread[-1] > 0.0:
        return 0.0
    return 2.0 * (samples * math.log(noise.spread[-1] / other.spread[-1]) + noise.order - other.order)


def _within_tolerance(rows: Array, free: int) -> LeastSquares:
    """Solve for all coefficients; the last `free` ones are expected to be 0 with standard deviation 1."""
    known = np.zeros((len(rows), free))
    known[-free:] = np.eye(free)
    columns = np.hstack([rows, known])
    return least_squares(columns[GAP:], columns[RESIDUAL])


def _words(shares: Array, deviations: Array, ramp: float) -> str:
    """Describe the direction that is needed most, and its size; `ramp` is the usual one of a growth, rad/s."""
    index = int(np.argmax(np.abs(shares) / np.maximum(deviations, 1e-9)))
    if index == len(_TOLERANCES):
        return f"a gap that grows by {math.degrees(ramp) * shares[index]:+.2g} deg/s would explain most of it"
    name = list(_TOLERANCES)[index]
    return f"a {name} off by {100.0 * _TOLERANCES[name] * shares[index]:+.2g} % would explain most of it"


@lru_cache(maxsize=32)
def _neighbours(servo: Servo, model: ReducedResponse) -> tuple[Neighbour, ...]:
    """Neighbours of a servo's response in stiffness, damping and the screw's compliance (of the structure's)."""
    rate, stiffness = 1.0 / model.response.interval, float(servo.stiffnesses.max())
    own = own_softness(servo)
    soft = 1.0 / _STIFF if servo.rigid else own * (1.0 + _STEP)
    stiffer, damped = variants(servo, list(math.log1p(_STEP) * np.eye(4)[:2]), rate)
    (softer,) = variants(servo, [np.zeros(4)], rate, [stiffness / soft])
    steps = ((stiffer, _STEP), (damped, _STEP), (softer, soft - own))
    return tuple(Neighbour.of(model, other, step, row) for row, (other, step) in enumerate(steps))


def observer_shift(result: WhitenedFit, servo: Servo, second: float) -> tuple[float, float]:
    """Return the change of the gap (rad) in the paper's observer form, and its standard deviation.

    The observer weights the residual by denominator / (s + alpha)^N; one step of Gauss and Newton in that weight.
    """
    reduction = result.reduction
    interval, alpha = reduction.response.interval * reduction.decimation.factor, _ALPHA / second
    weight, order = _weight(servo, alpha, interval)
    rows = np.array([weight.respond(row) for row in result.table])
    basis = orthonormal(np.vstack([rows[PLACE:], _transients(order, alpha * interval, rows.shape[1])]))
    remainder = project_out(basis, rows[[RESIDUAL, GAP]])
    information = float(remainder[1] @ remainder[1])
    if not information > 1e-12 * float(rows[GAP] @ rows[GAP]):
        return 0.0, math.inf
    direction = np.array([weight.respond(remainder[1][::-1])])[0][::-1] / information
    noise = result.noise.colour_back(direction)
    own = result.std
    return float(remainder[0] @ remainder[1]) / information, math.sqrt(max(0.0, float(noise @ noise) - own**2))


@lru_cache(maxsize=32)
def _weight(servo: Servo, alpha: float, interval: float) -> tuple[LagFilter, int]:
    """Weight of the observer form at a sample interval (s), and the observer's order."""
    model = observer(servo, alpha)
    return LagFilter.sampled(model.denominator, model.order, alpha, interval), model.order


def _transients(order: int, step: float, samples: int) -> Array:
    """(order, m) what the observer has not yet forgotten: t^i exp(-t), in steps of alpha times the interval."""
    time = step * np.arange(samples)
    return np.array([time**i * np.exp(-time) for i in range(order)])
