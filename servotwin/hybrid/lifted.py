"""Sampled loops in blocks of ticks: while nothing switches, a tick and the flow up to the next one are one linear map.

A *slot* holds everything about one map ``M``: its powers, and its *watches*, the quantities that must stay within
bounds, or the loop switches. Two scales: 8 intervals of one tick, and 16 intervals of 8 ticks. Over an interval a watch
is the cubic with its values and slopes at the ends, but for a deviation whose squares, summed over every interval of
the block, are the quadratic form of the start. So one product bounds every watch at every instant of a block.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined
from servotwin.hybrid.flow import SIGNIFICANT, advance, dot_sizes, product, tall_product
from servotwin.hybrid.tables import VECTOR, aligned, padded

FINE = 8
"""Intervals of the fine scale, one tick each; and ticks of an interval of the coarse scale."""
COARSE = 16
"""Intervals of the coarse scale."""
BLOCK = FINE * COARSE
# Rounding of a product with a row, of the sum of its terms' sizes, in units of `SIGNIFICANT`.
_ROUNDING = 0.01


class LiftedTables(NamedTuple):
    """Flat tables of `S` slots, `N` states, `W` watches each; rows of a level: per watch the values at the
    ends, the thirds of the slopes at the beginnings and at the ends of its intervals, and its deviation's matrix."""

    states: int
    watches: int
    fine: Array  # S * N * padded(W * (3 * 8 + 1 + N))
    coarse: Array  # S * N * padded(W * (3 * 16 + 1 + N))
    jump_fine: Array  # S * 8 * N * N, transposed: M**j - I
    jump_coarse: Array  # S * 16 * N * N, transposed: M**(8 j) - I
    sizes: Array  # S * W * N: a watch below this part of abs(z) times `SIGNIFICANT` is rounding


class LiftedWorkspace(NamedTuple):
    """Working memory to fill a slot; matrices are row-major."""

    map: Array  # N * N: M - I
    values: Array  # W * N: rows of the watches at a tick
    starts: Array  # W * N: thirds of their slopes over a tick, at its beginning
    ends: Array  # W * N: and at its end, of the state there
    sizes: Array  # W * N: sizes of all terms that enter a watch
    discrete: Array  # W: 1.0 where the watch counts at ticks only
    inside: Array  # W * N * N: squares of the deviation from the cubic within one tick
    powers: Array  # (8 + 16) * N * N
    rows: Array  # 3 * 9 * N: values, starts and ends at the ticks of an interval
    row: Array
    sums: Array  # N * N
    product: Array  # N * N
    column: Array


def new_lifted(states: int, watches: int, slots: int) -> LiftedTables:
    """Room for so many slots."""
    n2 = states * states
    sizes = (
        states * row_count(states, watches, FINE),
        states * row_count(states, watches, COARSE),
        FINE * n2,
        COARSE * n2,
        watches * states,
    )
    return LiftedTables(states, watches, *(aligned(np.zeros(slots * size)) for size in sizes))


def new_lifted_workspace(states: int, watches: int) -> LiftedWorkspace:
    """Working memory to fill slots."""
    n, n2 = states, states * states
    sizes = (
        n2,
        watches * n,
        watches * n,
        watches * n,
        watches * n,
        watches,
        watches * n2,
        24 * n2,
        27 * n,
        n,
        n2,
        n2,
        n,
    )
    return LiftedWorkspace(*(aligned(np.zeros(size)) for size in sizes))


def row_count(states: int, watches: int, intervals: int) -> int:
    """Columns of the table of a level."""
    return padded(watches * (3 * intervals + 1 + states))


@inlined
def _stride(t: LiftedTables, intervals: int) -> int:
    return (t.watches * (3 * intervals + 1 + t.states) + VECTOR - 1) // VECTOR * VECTOR


@bare
def _compose(n: int, powers: Array, to: int, a: int, b: int, row: Array) -> None:
    """``powers[to] = P_a + P_b + P_a P_b``: the deviation of the product of two maps."""
    for i in range(n):
        at = a + i * n
        product(powers, b, n, n, powers[at : at + n], row)
        for j in range(n):
            powers[to + i * n + j] = powers[at + j] + (powers[b + i * n + j] + row[j])


@bare
def _times(n: int, row: Array, matrix: Array, base: int, out: Array) -> None:
    """``row M`` from the deviation of ``M``."""
    product(matrix, base, n, n, row, out)
    for j in range(n):
        out[j] += row[j]


@bare
def add_square(n: int, row: Array, sums: Array, base: int) -> None:
    """Add ``row' row`` to a matrix."""
    for i in range(n):
        factor = row[i]
        if factor != 0.0:
            for j in range(n):
                sums[base + i * n + j] += factor * row[j]


@inlined
def cubic_weights(u: float, tilt: float) -> tuple[float, float, float, float]:
    """Bernstein's weights of a cubic's value at `u` of its interval, plus `tilt` times a third of its slope there."""
    v = 1.0 - u
    return (
        v * v * v - tilt * v * v,
        3.0 * v * v * u + tilt * (v * v - 2.0 * u * v),
        3.0 * v * u * u + tilt * (2.0 * u * v - u * u),
        u * u * u + tilt * u * u,
    )


@bare
def _double(n: int, power: int, w: LiftedWorkspace) -> None:
    """``G + M' G M`` for the power of ``M`` at that place: the sums over twice as many ticks."""
    for i in range(n):
        _times(n, w.sums[i * n : (i + 1) * n], w.powers, power, w.product[i * n : (i + 1) * n])
    for i in range(n):
        for j in range(n):
            w.column[j] = w.powers[power + j * n + i]
        product(w.product, 0, n, n, w.column, w.row)
        for j in range(n):
            w.sums[i * n + j] += w.product[i * n + j] + w.row[j]


@bare
def _transpose(n: int, source: Array, base: int, target: Array, to: int) -> None:
    for i in range(n):
        for j in range(n):
            target[to + j * n + i] = source[base + i * n + j]


@bare
def _fill_powers(t: LiftedTables, slot: int, w: LiftedWorkspace) -> None:
    n, n2 = t.states, t.states * t.states
    for i in range(n2):
        w.powers[i] = w.map[i]
    for j in range(1, FINE):
        _compose(n, w.powers, j * n2, (j - 1) * n2, 0, w.row)
    first = FINE * n2
    for i in range(n2):
        w.powers[first + i] = w.powers[(FINE - 1) * n2 + i]
    for j in range(1, COARSE):
        _compose(n, w.powers, first + j * n2, first + (j - 1) * n2, first, w.row)
    for j in range(FINE):
        _transpose(n, w.powers, j * n2, t.jump_fine, (slot * FINE + j) * n2)
    for j in range(COARSE):
        _transpose(n, w.powers, first + j * n2, t.jump_coarse, (slot * COARSE + j) * n2)


@bare
def _rows_at(n: int, watch: int, length: int, powers: int, w: LiftedWorkspace, i: int) -> None:
    """Value row, start row and end row at the i-th end of the intervals, into `rows`."""
    for kind in range(3):
        source = w.values if kind == 0 else (w.starts if kind == 1 else w.ends)
        row, to = source[watch * n : (watch + 1) * n], w.rows[(kind * 9) * n : (kind * 9 + 1) * n]
        if i == 0:
            for j in range(n):
                to[j] = row[j]
        else:
            _times(n, row, w.powers, powers + (i - 1) * n * n, to)
        if kind > 0:
            for j in range(n):
                to[j] *= length


@bare
def _fill_level(t: LiftedTables, table: Array, slot: int, watch: int, intervals: int, w: LiftedWorkspace) -> None:
    """Rows of one watch at one scale, and its deviation's matrix from `sums`."""
    n = t.states
    stride = _stride(t, intervals)
    length = 1 if intervals == FINE else FINE
    powers = 0 if intervals == FINE else FINE * n * n
    at = slot * n * stride + watch * (3 * intervals + 1 + n)
    for i in range(intervals + 1):
        _rows_at(n, watch, length, powers, w, i)
        for j in range(n):
            column = at + j * stride
            table[column + i] = w.rows[j]
            size = (slot * t.watches + watch) * n + j
            t.sizes[size] = max(t.sizes[size], _ROUNDING * abs(w.rows[j]))
            if i < intervals:
                table[column + intervals + 1 + i] = w.rows[9 * n + j]
            if i > 0:
                table[column + 2 * intervals + i] = w.rows[18 * n + j]
    square = at + 3 * intervals + 1
    for i in range(n):
        for j in range(n):
            table[square + j * stride + i] = w.sums[i * n + j]


@bare
def _coarse_deviation(t: LiftedTables, watch: int, w: LiftedWorkspace) -> None:
    """Add the squares of the tick's cubics' deviation from the cubic over 8 ticks to `sums`."""
    n, n2, base = t.states, t.states * t.states, watch * t.states
    for kind in range(3):
        source = w.values if kind == 0 else (w.starts if kind == 1 else w.ends)
        row = source[base : base + n]
        for i in range(FINE + 1):
            to = w.rows[(kind * 9 + i) * n : (kind * 9 + i + 1) * n]
            if i == 0:
                for j in range(n):
                    to[j] = row[j]
            else:
                _times(n, row, w.powers, (i - 1) * n2, to)
    for i in range(FINE):
        for point in range(1, 4):
            if point < 3 and w.discrete[watch] > 0.0:
                continue
            u = (i if point == 1 else i + 1) / FINE
            tilt = 0.0 if point == 3 else (1.0 if point == 1 else -1.0) / FINE
            c0, c1, c2, c3 = cubic_weights(u, tilt)
            for j in range(n):
                start, end = w.rows[j], w.rows[FINE * n + j]
                second = start + FINE * w.rows[9 * n + j]
                third = end - FINE * w.rows[(18 + FINE) * n + j]
                true = w.rows[(i if point == 1 else i + 1) * n + j]
                if point == 1:
                    true += w.rows[(9 + i) * n + j]
                elif point == 2:
                    true -= w.rows[(18 + i + 1) * n + j]
                w.row[j] = true - ((c0 * start + c1 * second) + (c2 * third + c3 * end))
            add_square(n, w.row, w.sums, 0)


@bare
def fill_slot(t: LiftedTables, slot: int, watches: int, w: LiftedWorkspace) -> None:
    """All tables of the map and the watches in `w`."""
    n, n2 = t.states, t.states * t.states
    _fill_powers(t, slot, w)
    for watch in range(watches):
        for i in range(n):
            t.sizes[(slot * t.watches + watch) * n + i] = w.sizes[watch * n + i]
        for i in range(n2):
            w.sums[i] = w.inside[watch * n2 + i]
        _double(n, 0, w)
        _double(n, n2, w)
        _double(n, 3 * n2, w)
        _fill_level(t, t.fine, slot, watch, int(FINE), w)
        _coarse_deviation(t, watch, w)
        for i in range(n2):
            # The square of a sum is at most twice the sum of the squares.
            w.sums[i] *= 2.0
        for place in (FINE, FINE + 1, FINE + 3, FINE + 7):
            _double(n, place * n2, w)
        _fill_level(t, t.coarse, slot, watch, int(COARSE), w)


@inlined
def clean_part(
    t: LiftedTables, slot: int, watches: int, intervals: int, wanted: int, low: Array, high: Array, slack: Array,
    z: Array, out: Array,
) -> int:  # fmt: skip
    """Number of intervals, at most `wanted`, before the first in which some watch may leave its bounds."""
    clean, n = wanted, np.uint64(t.states)
    for watch in range(watches):
        square, at = 0.0, np.uint64(watch * (3 * intervals + 1 + t.states) + 3 * intervals + 1)
        for i in range(n):
            square += out[at + i] * z[i]
        size = dot_sizes(t.sizes, (slot * t.watches + watch) * t.states, z)
        room = slack[watch] * (SIGNIFICANT * size) - math.sqrt(max(square, 0.0))
        top, bottom = high[watch] + room, low[watch] - room
        a = np.uint64(watch * (3 * intervals + 1 + t.states))
        b = a + np.uint64(intervals + 1)
        c = b + np.uint64(intervals)
        beyond = 0
        for k in range(np.uint64(clean)):
            begin, end = out[a + k], out[a + k + np.uint64(1)]
            second, third = begin + out[b + k], end - out[c + k]
            beyond += (max(max(begin, second), max(third, end)) > top) | (
                min(min(begin, second), min(third, end)) < bottom
            )
        if beyond > 0:
            for k in range(np.uint64(clean)):
                begin, end = out[a + k], out[a + k + np.uint64(1)]
                second, third = begin + out[b + k], end - out[c + k]
                if max(max(begin, second), max(third, end)) > top or min(min(begin, second), min(third, end)) < bottom:
                    clean = int(k)
                    break
    return clean


@inlined
def advance_ticks(
    t: LiftedTables, slot: int, watches: int, intervals: int, wanted: int, low: Array, high: Array, slack: Array,
    z: Array, out: Array, change: Array,
) -> int:  # fmt: skip
    """Advance through the first intervals of a block, at most `wanted`, in which no watch may leave its bounds; return
    their number."""
    stride = _stride(t, intervals)
    used = (watches * (3 * intervals + 1 + t.states) + VECTOR - 1) // VECTOR * VECTOR
    if intervals == FINE:
        tall_product(t.fine, slot * t.states * stride, stride, used, z, out)
    else:
        tall_product(t.coarse, slot * t.states * stride, stride, used, z, out)
    clean = clean_part(t, slot, watches, intervals, wanted, low, high, slack, z, out)
    if clean > 0:
        n2 = t.states * t.states
        if intervals == FINE:
            advance(t.jump_fine, (slot * FINE + clean - 1) * n2, z, change)
        else:
            advance(t.jump_coarse, (slot * COARSE + clean - 1) * n2, z, change)
    return clean
