"""Matrix exponentials in extended precision, kept as ``exp(A t) - I``.

A step is applied as ``x += P @ x``: the rounding of a stored ``exp(A t)`` would be the same in every step and
accumulate; that of ``P`` is smaller by the size of the step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

Long = NDArray[np.longdouble]
_TERMS = 24


def expm1(flow: NDArray[np.float64], time: float) -> Long:
    """``exp(flow * time) - I`` of an ``(n, n)`` matrix, by scaling, Taylor series and squaring of the deviation from
    one."""
    balanced, (scale, _) = matrix_balance(flow, permute=False, separate=True)
    matrix = balanced.astype(np.longdouble) * np.longdouble(time)
    halvings = max(0, int(np.ceil(np.log2(max(float(np.abs(matrix).sum(axis=1).max()), 1e-300)))) + 2)
    matrix = matrix / np.longdouble(2) ** halvings
    term, result = matrix, matrix.copy()
    for order in range(2, _TERMS):
        term = term @ matrix / np.longdouble(order)
        result += term
    for _ in range(halvings):
        result = 2 * result + result @ result
    return np.asarray(scale[:, None] * result / scale[None, :], dtype=np.longdouble)


def powers(step: Long, count: int) -> Long:
    """``(I + step)**j - I`` for j = 1 .. count, ``(count, n, n)``."""
    result = [step]
    while len(result) < count:
        result.append(result[-1] + step + result[-1] @ step)
    return np.array(result)


def taylor_rows(row: NDArray[np.float64], flow: NDArray[np.float64], time: float, terms: int) -> Long:
    """Rows ``row @ (flow*time)**k / k!``, k = 0 .. terms - 1: the Taylor series of ``row @ x(t)`` over `time`.

    `row` is ``(n,)`` or ``(r, n)``; the result is ``(terms, n)`` or ``(terms, r, n)``.
    """
    scaled = flow.astype(np.longdouble) * np.longdouble(time)
    rows = [row.astype(np.longdouble)]
    for order in range(1, terms):
        rows.append(rows[-1] @ scaled / np.longdouble(order))
    return np.array(rows)
