"""The noise in what a joint fit leaves of a window."""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.core.decimation import Decimation
from servotwin.estimation.core.normal import least_squares
from servotwin.estimation.core.projection import orthonormal
from servotwin.estimation.core.whitening import Autoregression, recursion
from servotwin.estimation.joint.model import MOTOR_START, JointModel
from servotwin.estimation.joint.search import Stand
from servotwin.plant.signals import Array

_LEAST = 1e-300


def noise_left(
    model: JointModel, found: Stand, reduce: Decimation, before: Autoregression, order: int, put: bool
) -> Autoregression:
    """The noise in the residual of a fit that was made with a first idea of it.

    A fit takes noise away with every parameter, and most where the gap shows, so that what is left looks quieter there
    than the noise was. With `put`, what it may have taken is put back, as equally likely series: one standard deviation
    up and down along every direction of the parameters.
    """
    table = _kept(model, model.table(dict(zip(model.names, found.point.tolist(), strict=True)), reduce.rows))
    rows = before.whiten(table)
    solved = least_squares(rows[1:], rows[0])
    left = table[0] - solved.coefficients @ table[1:]
    if not np.any(left):
        return Autoregression.white(1.0)
    if not put:
        return likeliest(left[None], table, order)
    rest = rows[0] - solved.coefficients @ rows[1:]
    scale = math.sqrt(float(rest @ rest) / max(1, rest.size - len(solved.root)))
    taken = scale * math.sqrt(len(solved.root)) * (solved.root @ table[1:])
    return likeliest(np.vstack([left + taken, left - taken]), table, order)


def likeliest(series: Array, table: Array, most: int) -> Autoregression:
    """The autoregression by Burg's method of equally likely series (s, n), its order the likeliest for what was fitted.

    The likelihood is the restricted one, that of the data `table[0]` off what the columns `table[1:]` can explain. The
    plain one prefers orders that model the hole which the fit itself left in the noise, and spreads come out too small.
    """
    predictors, power = recursion(series, min(most, series.shape[1] // 4))
    spreads = np.sqrt(np.maximum(power, _LEAST))
    orders = [Autoregression(predictors[:n, :n].copy(), spreads[:n]) for n in range(1, power.size + 1)]
    rows = np.vstack([table[:1], orthonormal(table[1:])])
    return min(orders, key=lambda noise: restricted(noise, rows))


def restricted(noise: Autoregression, rows: Array) -> float:
    """Minus twice the restricted log-likelihood of rows[0] off rows[1:], and the corrected Akaike penalty.

    The level of the noise is free.
    """
    size, white = rows.shape[1], noise.whiten(rows)
    left = white[0] - least_squares(white[1:], white[0]).coefficients @ white[1:]
    degrees, count = max(1, size - len(white) + 1), noise.order + 1
    level = degrees * math.log(max(float(left @ left) / degrees, _LEAST))
    spreads = noise.spread[np.minimum(np.arange(size), noise.order)]
    information = float(np.linalg.slogdet(white[1:] @ white[1:].T)[1])
    likelihood = 2.0 * float(np.log(spreads).sum()) + level + information
    return likelihood + 2.0 * count * size / max(1, size - count - 1)


def _kept(model: JointModel, table: Array) -> Array:
    """The rows without those of the motor's start, which is over in milliseconds and takes little away."""
    first = len(table) - len(model.names)
    return np.delete(table, [first + i for i, name in enumerate(model.names) if name in MOTOR_START], axis=0)
