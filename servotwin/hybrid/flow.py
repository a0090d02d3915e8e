"""Advancing a state by tables of ``exp(A t) - I``: whole steps, blocks of them, and parts of one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import inlined, summed
from servotwin.hybrid.polynomial import DEPTH
from servotwin.hybrid.tables import (
    NODES_COARSE,
    PART_POWERS,
    PARTS,
    TERMS,
    VECTOR,
    Pending,
    Tables,
    nothing_pending,
    padded,
    zeros,
)

# A guard's value or derivative below this part of all the terms that ever enter it is rounding, hence zero. Each
# derivative is measured against its own terms: as a guard that looks at this derivative alone would measure it, so that
# two modes agree on the sign of the same quantity.
SIGNIFICANT = 1e-13
# A block lets a guard rise to this many times its rounding. A state that drifts by less than its last digit a step does
# not move in one: with a bound of one rounding it stood just below it, and every later step was looked at by itself.
# Beyond one rounding the next step's own search finds the guard, so that a run cannot stand still at either bound.
LINGERING = 2.0


class Scratch(NamedTuple):
    """Working memory of one run."""

    pending: Pending
    rows: Array
    series: Array
    change: Array
    powers: Array
    sums: Array
    starts: Array
    ends: Array


def new_scratch(tables: Tables, pending: Pending | None = None) -> Scratch:
    """Working memory for one run; `pending` where not all of the tables are filled."""
    n = tables.states
    rows = max(padded(2 * tables.guards * (NODES_COARSE + 1)), n + 4 * tables.guards)
    sizes = (rows, TERMS, n, n * PART_POWERS, n, DEPTH + 2, DEPTH + 2)
    return Scratch(pending or nothing_pending(tables), *(zeros(size) for size in sizes))


@inlined
def product(table: Array, base: int, stride: int, rows: int, x: Array, out: Array) -> None:
    """``out[r] = sum of table[base + j * stride + r] * x[j]``: four columns at a time, so that `out` is stored less
    often."""
    count, n, step = np.uint64(rows), np.uint64(x.size), np.uint64(stride)
    at: Any = np.uint64(base)
    fours = n // np.uint64(4)
    for r in range(count):
        out[r] = 0.0
    for block in range(fours):
        j = block * np.uint64(4)
        x0, x1, x2, x3 = x[j], x[j + np.uint64(1)], x[j + np.uint64(2)], x[j + np.uint64(3)]
        b = at + step
        c = b + step
        d = c + step
        for r in range(count):
            out[r] += (table[at + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)
        at = d + step
    for rest in range(fours * np.uint64(4), n):
        factor = x[rest]
        for r in range(count):
            out[r] += table[at + r] * factor
        at += step


@inlined
def tall_product(table: Array, base: int, stride: int, rows: int, x: Array, out: Array) -> None:
    """The same for many rows: eight columns at a time, then four, then each."""
    count, n, step = np.uint64(rows), np.uint64(x.size), np.uint64(stride)
    at: Any = np.uint64(base)
    eights = n // np.uint64(8)
    if eights == 0:
        for r in range(count):
            out[r] = 0.0
    for block in range(eights):
        j = block * np.uint64(8)
        x0, x1, x2, x3 = x[j], x[j + np.uint64(1)], x[j + np.uint64(2)], x[j + np.uint64(3)]
        x4, x5, x6, x7 = x[j + np.uint64(4)], x[j + np.uint64(5)], x[j + np.uint64(6)], x[j + np.uint64(7)]
        b = at + step
        c = b + step
        d = c + step
        e = d + step
        f = e + step
        g = f + step
        h = g + step
        # The first ones are stored: to clear and to add would be one more way through memory.
        if block == 0:
            for r in range(count):
                out[r] = ((table[at + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)) + (
                    (table[e + r] * x4 + table[f + r] * x5) + (table[g + r] * x6 + table[h + r] * x7)
                )
        else:
            for r in range(count):
                out[r] += ((table[at + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)) + (
                    (table[e + r] * x4 + table[f + r] * x5) + (table[g + r] * x6 + table[h + r] * x7)
                )
        at = h + step
    begin: Any = eights * np.uint64(8)
    if n - begin >= np.uint64(4):
        x0, x1, x2, x3 = x[begin], x[begin + np.uint64(1)], x[begin + np.uint64(2)], x[begin + np.uint64(3)]
        b = at + step
        c = b + step
        d = c + step
        for r in range(count):
            out[r] += (table[at + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)
        at = d + step
        begin += np.uint64(4)
    for rest in range(begin, n):
        factor = x[rest]
        for r in range(count):
            out[r] += table[at + r] * factor
        at += step


@inlined
def listed_product(
    table: Array, base: int, stride: int, rows: int, which: NDArray[np.int64], x: Array, out: Array
) -> None:
    """The same for columns that are listed: ``out[r] = sum of table[base + which[j] * stride + r] * x[j]``."""
    count, n, step, first = np.uint64(rows), np.uint64(x.size), np.uint64(stride), np.uint64(base)
    eights = n // np.uint64(8)
    if eights == 0:
        for r in range(count):
            out[r] = 0.0
    for block in range(eights):
        j = block * np.uint64(8)
        x0, x1, x2, x3 = x[j], x[j + np.uint64(1)], x[j + np.uint64(2)], x[j + np.uint64(3)]
        x4, x5, x6, x7 = x[j + np.uint64(4)], x[j + np.uint64(5)], x[j + np.uint64(6)], x[j + np.uint64(7)]
        a = first + np.uint64(which[j]) * step
        b = first + np.uint64(which[j + np.uint64(1)]) * step
        c = first + np.uint64(which[j + np.uint64(2)]) * step
        d = first + np.uint64(which[j + np.uint64(3)]) * step
        e = first + np.uint64(which[j + np.uint64(4)]) * step
        f = first + np.uint64(which[j + np.uint64(5)]) * step
        g = first + np.uint64(which[j + np.uint64(6)]) * step
        h = first + np.uint64(which[j + np.uint64(7)]) * step
        if block == 0:
            for r in range(count):
                out[r] = ((table[a + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)) + (
                    (table[e + r] * x4 + table[f + r] * x5) + (table[g + r] * x6 + table[h + r] * x7)
                )
        else:
            for r in range(count):
                out[r] += ((table[a + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)) + (
                    (table[e + r] * x4 + table[f + r] * x5) + (table[g + r] * x6 + table[h + r] * x7)
                )
    begin: Any = eights * np.uint64(8)
    if n - begin >= np.uint64(4):
        x0, x1, x2, x3 = x[begin], x[begin + np.uint64(1)], x[begin + np.uint64(2)], x[begin + np.uint64(3)]
        a = first + np.uint64(which[begin]) * step
        b = first + np.uint64(which[begin + np.uint64(1)]) * step
        c = first + np.uint64(which[begin + np.uint64(2)]) * step
        d = first + np.uint64(which[begin + np.uint64(3)]) * step
        for r in range(count):
            out[r] += (table[a + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)
        begin += np.uint64(4)
    for rest in range(begin, n):
        factor, a = x[rest], first + np.uint64(which[rest]) * step
        for r in range(count):
            out[r] += table[a + r] * factor


@inlined
def wide_product(table: Array, base: int, stride: int, rows: int, x: Array, out: Array) -> None:
    """The same for sixteen columns and a multiple of eight rows, in one go."""
    at, step = np.uint64(base), np.uint64(stride)
    x0, x1, x2, x3, x4, x5, x6, x7 = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7]
    x8, x9, xa, xb, xc, xd, xe, xf = x[8], x[9], x[10], x[11], x[12], x[13], x[14], x[15]
    for r in range(np.uint64(rows)):
        i0 = at + r
        i4 = i0 + step * np.uint64(4)
        i8 = i4 + step * np.uint64(4)
        ic = i8 + step * np.uint64(4)
        s2, s3 = step + step, step + step + step
        a = (table[i0] * x0 + table[i0 + step] * x1) + (table[i0 + s2] * x2 + table[i0 + s3] * x3)
        b = (table[i4] * x4 + table[i4 + step] * x5) + (table[i4 + s2] * x6 + table[i4 + s3] * x7)
        c = (table[i8] * x8 + table[i8 + step] * x9) + (table[i8 + s2] * xa + table[i8 + s3] * xb)
        d = (table[ic] * xc + table[ic + step] * xd) + (table[ic + s2] * xe + table[ic + s3] * xf)
        out[r] = (a + b) + (c + d)


@summed
def dot(table: Array, base: int, x: Array) -> float:
    """``sum of table[base + j] * x[j]``."""
    total, at = 0.0, np.uint64(base)
    for j in range(np.uint64(x.size)):
        total += table[at + j] * x[j]
    return total


@summed
def dot_sizes(table: Array, base: int, x: Array) -> float:
    """``sum of table[base + j] * abs(x[j])``."""
    total, at = 0.0, np.uint64(base)
    for j in range(np.uint64(x.size)):
        total += table[at + j] * abs(x[j])
    return total


@inlined
def rounding(t: Tables, mode: int, guard: int, order: int, x: Array) -> float:
    """Part of a guard's Taylor coefficient (in steps) that may be rounding."""
    return SIGNIFICANT * dot_sizes(t.sizes, ((mode * t.guards + guard) * TERMS + order) * t.states, x)


@inlined
def advance(table: Array, base: int, x: Array, change: Array) -> None:
    """``x += P @ x`` with the transposed ``(n, n)`` matrix at `base`."""
    product(table, base, x.size, x.size, x, change)
    for i in range(np.uint64(x.size)):
        x[i] += change[i]


@inlined
def advance_fraction(t: Tables, mode: int, x: Array, fraction: float, scratch: Scratch) -> None:
    """Advance by ``fraction`` of a step: a tabled part, then a Taylor series of 12 terms.

    The first four powers of the flow applied to the state, which need one product, are the terms of all orders but for
    weights and the fourth power: two products more.
    """
    n, flow = np.uint64(t.states), t.flow_of[mode]
    n_2, n_3 = n + n, n + n + n
    part = min(int(fraction * PARTS), PARTS - 1)
    rest = fraction * PARTS - part
    change, powers, sums = scratch.change, scratch.powers, scratch.sums
    if part > 0:
        advance(t.jump_part, (flow * PARTS + part) * t.states * t.states, x, change)
    base, stride = flow * t.states * t.states * PART_POWERS, t.states * PART_POWERS
    if t.states == 16:
        wide_product(t.flow_part, base, stride, stride, x, powers)
    else:
        tall_product(t.flow_part, base, stride, stride, x, powers)
    w2 = rest * rest * (1 / 2)
    w3 = w2 * rest * (1 / 3)
    w4 = w3 * rest * (1 / 4)
    w5 = w4 * rest * (1 / 5)
    w6 = w5 * rest * (1 / 6)
    w7 = w6 * rest * (1 / 7)
    w8 = w7 * rest * (1 / 8)
    w9 = w8 * rest * (1 / 9)
    w10 = w9 * rest * (1 / 10)
    w11 = w10 * rest * (1 / 11)
    w12 = w11 * rest * (1 / 12)
    for i in range(n):
        sums[i] = (w8 * x[i] + w9 * powers[i]) + (w10 * powers[n + i] + w11 * powers[n_2 + i]) + w12 * powers[n_3 + i]
    fourth = base + 3 * t.states
    product(t.flow_part, fourth, stride, t.states, sums, change)
    for i in range(n):
        sums[i] = change[i] + ((w4 * x[i] + w5 * powers[i]) + (w6 * powers[n + i] + w7 * powers[n_2 + i]))
    product(t.flow_part, fourth, stride, t.states, sums, change)
    for i in range(n):
        x[i] += change[i] + (rest * powers[i] + (w2 * powers[n + i] + w3 * powers[n_2 + i]))


@inlined
def clean_intervals(t: Tables, mode: int, x: Array, out: Array, rows: int, limit: int) -> int:
    """Number of intervals, at most `limit`, before the first in which some guard may become positive.

    More than rounding, that is: a loop at rest would otherwise be looked at step by step for ever.
    """
    # To numba a number that is now int64, now uint64 is a float, and with it every step that is counted from here on.
    clean: Any = limit
    thirds = np.uint64(t.guard_count[mode] * rows)
    for g in range(t.guard_count[mode]):
        least = LINGERING * rounding(t, mode, g, 0, x)
        first, beyond = np.uint64(g * rows), 0
        # Counted at first, for that is many at a time: most guards stay away.
        for k in range(np.uint64(clean)):
            at = first + k
            begin, end = out[at], out[at + np.uint64(1)]
            second, third = begin + out[thirds + at], end - out[thirds + at + np.uint64(1)]
            beyond += max(max(begin, second), max(third, end)) > least
        if beyond > 0:
            for k in range(np.uint64(clean)):
                at = first + k
                begin, end = out[at], out[at + np.uint64(1)]
                second, third = begin + out[thirds + at], end - out[thirds + at + np.uint64(1)]
                if max(max(begin, second), max(third, end)) > least:
                    clean = np.int64(k)
                    break
    return clean


@inlined
def advance_clean(
    t: Tables, table: Array, jumps: Array, nodes: int, limit: int, mode: int, x: Array, scratch: Scratch
) -> int:
    """Advance through the first intervals of a block, at most `limit`, in which no guard may become positive.

    `table` and `jumps` are those of one scale; returns the number of intervals advanced.
    """
    out, guards = scratch.rows, t.guard_count[mode]
    values = guards * (nodes + 1)
    stride = (2 * t.guards * (nodes + 1) + VECTOR - 1) // VECTOR * VECTOR
    used = (2 * values + VECTOR - 1) // VECTOR * VECTOR
    if t.states == 16:
        wide_product(table, mode * t.states * stride, stride, used, x, out)
    else:
        tall_product(table, mode * t.states * stride, stride, used, x, out)
    positive = 0
    for r in range(np.uint64(values)):
        positive += out[r] + abs(out[np.uint64(values) + r]) > 0.0
    clean = limit if positive == 0 else clean_intervals(t, mode, x, out, nodes + 1, limit)
    if clean > 0:
        advance(jumps, (t.flow_of[mode] * nodes + clean - 1) * t.states * t.states, x, scratch.change)
    return clean
