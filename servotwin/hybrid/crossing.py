"""First time within one search step at which a guard becomes positive: the first root of its Taylor polynomial."""

from __future__ import annotations

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import inlined
from servotwin.hybrid.flow import Scratch, dot, dot_sizes, product, rounding
from servotwin.hybrid.polynomial import CUBIC_ERROR, first_positive, fourth_derivative_bound
from servotwin.hybrid.tables import PIECES, TERMS, Tables

# A coefficient below this part of the largest one: 24 of them are below its rounding.
NEGLIGIBLE = 1e-18


@inlined
def series(t: Tables, mode: int, guard: int, x: Array, margin: float, c: Array) -> int:
    """Fill `c` with the Taylor coefficients of a guard over a step; return the order of the first that is more than
    `margin` times its rounding, `TERMS` where none is.

    Where as many as there are states are zero, all are (Cayley and Hamilton): a later one is rounding, whatever its
    size. Taken for motion it made a machine at rest on a flank leave it and come back without end.
    """
    product(t.taylor, (mode * t.guards + guard) * t.states * TERMS, TERMS, TERMS, x, c)
    for order in range(min(TERMS, t.states)):
        if abs(c[order]) > margin * rounding(t, mode, guard, order, x):
            return order
    return TERMS


@inlined
def is_leaving(t: Tables, mode: int, guard: int, x: Array, margin: float, c: Array) -> bool:
    """True when the guard is positive now or at once: the sign of its first Taylor coefficient that is not rounding."""
    base = (mode * t.guards + guard) * t.states
    value = dot(t.rows, base, x)
    if abs(value) > margin * rounding(t, mode, guard, 0, x):
        return value > 0.0
    first = series(t, mode, guard, x, margin, c)
    return first < TERMS and c[first] > 0.0


@inlined
def significant(c: Array) -> int:
    """Number of leading coefficients, at least two, after which all the rest cannot change a value on [0, 1]."""
    largest = 0.0
    for k in range(TERMS):
        largest = max(largest, abs(c[k]))
    terms = TERMS
    while terms > 2 and abs(c[terms - 1]) < NEGLIGIBLE * largest:
        terms -= 1
    return terms


@inlined
def _search_unit(t: Tables, scratch: Scratch) -> float:
    c, b = scratch.series, scratch.rows
    product(t.bernstein, 0, 3 * PIECES + 1, 3 * PIECES + 1, c, b)
    c = c[: significant(c)]
    error = CUBIC_ERROR * fourth_derivative_bound(c, 1.0) / PIECES**4
    for piece in range(PIECES):
        at = 3 * piece
        # No Bernstein coefficient above zero: the cubic stays below zero, and the guard too, by the bound of the error.
        if max(b[at], b[at + 1], b[at + 2], b[at + 3]) + error > 0.0:
            root = first_positive(c, piece / PIECES, (piece + 1) / PIECES, scratch.starts, scratch.ends)
            if root < np.inf:
                return root
    return np.inf


@inlined
def next_crossing(t: Tables, mode: int, guard: int, x: Array, length: float, margin: float, scratch: Scratch) -> float:
    """First time in (0, length] steps at which the guard becomes positive, 0 when it is leaving now, inf when it does
    not."""
    base = (mode * t.guards + guard) * t.states
    if dot(t.rows, base, x) + dot_sizes(t.changes, base, x) < 0.0:
        # Not even with every term of the series at its worst.
        return np.inf
    c = scratch.series
    first = series(t, mode, guard, x, margin, c)
    # The guard is zero on the whole step but for rounding: a mode may last on its own boundary.
    if first == TERMS:
        return np.inf
    if c[first] > 0.0:
        return 0.0
    if first > 0 or length < 1.0:
        # Leading zeros are divided out: the guard starts at zero and moves away.
        power = 1.0
        for k in range(TERMS - first):
            c[k] = c[k + first] * power
            power *= length
        for k in range(TERMS - first, TERMS):
            c[k] = 0.0
    return _search_unit(t, scratch) * length
