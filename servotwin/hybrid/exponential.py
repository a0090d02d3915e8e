"""Matrix exponentials stored as ``exp(A t) - I``, each entry a double and the remainder of its rounding.

A step is applied as ``x += P @ x``: the rounding of a stored ``exp(A t)`` would be the same in every step and
accumulate; that of ``P`` is smaller by the size of the step. Sums carry their remainders along; products of two
deviations are plain, because they are smaller than the deviations themselves.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgebal

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, subroutine, verbatim
from servotwin.hybrid.flow import product
from servotwin.hybrid.tables import Powers, new_powers

# More orders than any series of a matrix of norm 1/4 has terms above rounding.
_MOST_TERMS = 40
# Terms below this part of the sum do not change it.
_SMALL = 2.0**-60
# Veltkamp's constant splits a double into halves whose products are exact.
_SPLIT = 2.0**27 + 1.0


@verbatim
def _sum(a: float, b: float) -> tuple[float, float]:
    """Sum and what rounding left of it."""
    # Knuth's sum without error. Reordered, as fast-math would do it, the remainder is zero; hence `verbatim`.
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@verbatim
def _product(a: float, b: float) -> tuple[float, float]:
    """Product and what rounding left of it."""
    result = a * b
    # Dekker's product without error, from exact products of halves.
    big = _SPLIT * a
    a_high = big - (big - a)
    big = _SPLIT * b
    b_high = big - (big - b)
    a_low, b_low = a - a_high, b - b_high
    return result, a_low * b_low - (((result - a_high * b_high) - a_low * b_high) - a_high * b_low)


@verbatim
def _third(a: float, a_low: float, b: float, b_low: float, c: float) -> tuple[float, float]:
    """``a + b + c`` with remainders."""
    total, left = _sum(a, b)
    total, more = _sum(total, c)
    return _sum(total, (a_low + b_low) + (left + more))


@inlined
def _multiply(a: Array, b: Array, n: int, p: Powers) -> None:
    """The moving rows of ``a @ b`` as the change."""
    for place in range(p.movers[0]):
        at = p.moving[place] * n
        product(b, 0, n, n, a[at : at + n], p.change[at : at + n])


@subroutine
def rebase(n: int, p: Powers) -> None:
    """The present power becomes the base: what comes next are powers of it."""
    for i in range(n * n):
        p.base[i], p.base_low[i] = p.power[i], p.power_low[i]


@subroutine
def start_powers(flow: Array, base: int, n: int, time: float, p: Powers) -> None:
    """The first power of ``flow[base:]``, ``(n, n)`` flat, over a time in which no eigenvalue turns far: its Taylor
    series."""
    p.movers[0] = 0
    for i in range(n):
        size = 0.0
        for at in range(i * n, (i + 1) * n):
            p.power[at], p.power_low[at] = _product(flow[base + at], time)
            p.base[at] = p.term[at] = p.power[at]
            p.base_low[at] = 0.0
            size += abs(p.power[at])
        if size > 0.0:
            p.moving[p.movers[0]] = i
            p.movers[0] += 1
    for order in range(2, _MOST_TERMS):
        _multiply(p.term, p.base, n, p)
        open_terms = 0
        for place in range(p.movers[0]):
            for at in range(p.moving[place] * n, (p.moving[place] + 1) * n):
                p.term[at] = p.change[at] / order
                p.power[at], p.power_low[at] = _third(p.power[at], p.power_low[at], p.term[at], 0.0, 0.0)
                open_terms += abs(p.term[at]) > _SMALL * abs(p.power[at])
        if open_terms == 0:
            break
    rebase(n, p)


@subroutine
def next_power(n: int, p: Powers) -> None:
    """One base more: ``exp(A (j + 1) t) - I = B + P + B P``."""
    _multiply(p.base, p.power, n, p)
    for place in range(p.movers[0]):
        for i in range(p.moving[place] * n, (p.moving[place] + 1) * n):
            p.power[i], p.power_low[i] = _third(p.base[i], p.base_low[i], p.power[i], p.power_low[i], p.change[i])


@bare
def _expm1(flow: Array, n: int, time: float, halvings: int, p: Powers) -> None:
    start_powers(flow, 0, n, time * 0.5**halvings, p)
    for _ in range(halvings):
        next_power(n, p)
        rebase(n, p)


def expm1(flow: Array, time: float) -> Array:
    """``exp(flow * time) - I`` of an ``(n, n)`` matrix, by scaling, Taylor series and squaring of the deviation from
    one."""
    n, powers = len(flow), new_powers(len(flow))
    flow = np.asarray_chkfinite(flow, dtype=float)
    # Balanced for its size only: the units of the states must not decide the number of halvings. By LAPACK itself:
    # `scipy.linalg.matrix_balance` around it takes six times as long, more than all else here.
    balanced = dgebal(flow, scale=True, permute=False)[0]
    size = float(np.abs(balanced).sum(axis=1).max()) * abs(time)
    # To a norm of at most 1/4, for which the series ends within `_MOST_TERMS`.
    halvings = max(0, int(np.ceil(np.log2(max(size, 1e-300)))) + 2)
    _expm1(flow.flatten(), n, float(time), halvings, powers)
    return powers.power.reshape(n, n)
