"""The first time a polynomial becomes positive: compiled helpers on coefficient arrays."""

from __future__ import annotations

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import inlined

# Halvings of an interval: roots closer together than 2**-40 of it count as one.
DEPTH = 40
_NEWTON_STEPS = 100
_CONVERGED = 1e-9
# A cubic with the values and slopes of f at both ends of an interval of length h differs from f by at most h**4 / 384
# times the largest fourth derivative; its slope by sqrt(3) h**3 / 216 times that.
CUBIC_ERROR = 1.0 / 384.0
SLOPE_ERROR = 3.0**0.5 / 216.0


@inlined
def value_and_slope(c: Array, t: float) -> tuple[float, float]:
    """Horner's scheme for the polynomial ``sum c[k] t**k`` and its derivative."""
    value, slope = c[-1], 0.0
    for k in range(len(c) - 2, -1, -1):
        slope = slope * t + value
        value = value * t + c[k]
    return value, slope


@inlined
def bracketed_root(c: Array, low: float, high: float, at_low: float, at_high: float) -> float:
    """Root in [low, high] given ``p(low) <= 0 < p(high)``: Newton from the secant, bisection whenever it leaves the
    bracket."""
    t = low - at_low * (high - low) / (at_high - at_low)
    for _ in range(_NEWTON_STEPS):
        value, slope = value_and_slope(c, t)
        if value > 0.0:
            high = t
        else:
            low = t
        # Beyond the bracket on purpose where Newton has no slope to follow: a bisection comes next.
        new = t - value / slope if slope > 0.0 else high + 1.0
        if not low <= new <= high:
            new = 0.5 * (low + high)
        # Newton's next error is of the order of this one's square.
        if abs(new - t) <= _CONVERGED * abs(new):
            return new
        t = new
    return t


@inlined
def fourth_derivative_bound(c: Array, end: float) -> float:
    """Bound of the fourth derivative's size on [0, end]."""
    bound = 0.0
    for k in range(len(c) - 1, 3, -1):
        bound = bound * end + abs(c[k]) * (k * (k - 1) * (k - 2) * (k - 3))
    return bound


@inlined
def first_positive(c: Array, low: float, high: float, starts: Array, ends: Array) -> float:
    """First t in (low, high] from which ``p > 0``, given ``p(low) <= 0``; inf when there is none.

    Intervals are halved, left first, until their cubic (values and slopes at the ends) stays below zero, or rises
    through it monotonically, by more than it can differ from the polynomial. `starts` and `ends` are working memory
    for DEPTH + 2 intervals.
    """
    starts[0], ends[0] = low, high
    smallest = (high - low) * 0.5**DEPTH
    fourth = fourth_derivative_bound(c, high)
    top = 1
    while top > 0:
        top -= 1
        a, b = starts[top], ends[top]
        third = (b - a) / 3.0
        at_a, slope_a = value_and_slope(c, a)
        at_b, slope_b = value_and_slope(c, b)
        inner_a, inner_b = at_a + third * slope_a, at_b - third * slope_b
        if at_a > 0.0:
            return a
        cubed = (b - a) * (b - a) * (b - a)
        if max(at_a, inner_a, inner_b, at_b) + CUBIC_ERROR * fourth * cubed * (b - a) <= 0.0:
            continue
        slope_error = SLOPE_ERROR * fourth * cubed
        rises = at_b > 0.0 and min(slope_a, slope_b, (inner_b - inner_a) / third) >= slope_error
        if rises or b - a <= smallest:
            if at_b > 0.0:
                return bracketed_root(c, a, b, at_a, at_b)
            continue
        middle = 0.5 * (a + b)
        # The right half first: the left one, on top of the stack, is searched before it.
        starts[top], ends[top] = middle, b
        starts[top + 1], ends[top + 1] = a, middle
        top += 2
    return np.inf
