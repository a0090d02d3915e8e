"""A step of Levenberg and Marquardt's method within bounds, compiled: as many calls of numpy take longer."""

from __future__ import annotations

import numpy as np

from servotwin.estimation.core.elimination import solve
from servotwin.estimation.core.least_squares import Flags, inner
from servotwin.hybrid.compiled import bare
from servotwin.plant.signals import Array


def bounded_step(
    residual: Array, rows: Array, movable: Flags, q: Array, low: Array, high: Array, damping: float
) -> tuple[Array, float]:
    """The damped Gauss-Newton step within bounds, and the decrease of the cost that it promises.

    A coordinate at its bound that wants to leave stays. The promise is that of a linear residual.

    Parameters
    ----------
    residual : (n,) array
    rows : (k, n) array
        Minus its derivatives.
    movable : (k,) array of bool
    q, low, high : (k,) arrays
        The point, and its bounds.
    damping : float
        Of the products of derivatives of length one.
    """
    step = np.empty(q.size)
    room = np.empty((2, q.size, q.size)), np.empty(q.size)
    return step, take_step(residual, rows, movable, q, low, high, damping, *room, step)


@bare
def take_step(
    residual: Array,
    rows: Array,
    movable: Flags,
    q: Array,
    low: Array,
    high: Array,
    damping: float,
    matrix: Array,
    size: Array,
    step: Array,
) -> float:
    """`bounded_step` into `step`; return the promise. `matrix` (2, k, k) and `size` (k,) are room."""
    products, scaled = matrix[0], matrix[1]
    count, promised = q.size, 0.0
    for i in range(count):
        for j in range(i + 1):
            products[i, j] = products[j, i] = inner(rows[i], rows[j])
    for i in range(count):
        downhill = inner(rows[i], residual)
        blocked = (q[i] <= low[i] and downhill < 0.0) or (q[i] >= high[i] and downhill > 0.0)
        free = movable[i] and not blocked and products[i, i] > 0.0
        size[i] = np.sqrt(products[i, i]) if free else np.inf
        step[i] = downhill / size[i]
        for j in range(i + 1):
            scaled[i, j] = scaled[j, i] = products[i, j] / size[i] / size[j]
        scaled[i, i] = 1.0 + damping
    solve(scaled, step)
    for i in range(count):
        step[i] = min(max(q[i] + step[i] / size[i], low[i]), high[i]) - q[i]
    for i in range(count):
        promised += 2.0 * step[i] * inner(rows[i], residual)
        for j in range(count):
            promised -= step[i] * products[i, j] * step[j]
    return promised
