"""Sampled loops in blocks of ticks: while nothing switches, a tick and the flow up to the next one are one linear map.

A *slot* holds everything about one map ``M``: its powers, and its *watches*, the quantities that must stay within
bounds, or the loop switches. Three scales: 8 intervals of one tick, 16 of 8 ticks, 16 of 128 ticks. Over an interval a
watch is the cubic with its values and slopes at the ends, but for a deviation whose squares, summed over every
interval of the block, are the quadratic form of the start. So one product bounds every watch at every instant of a
block.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import inlined, subroutine
from servotwin.hybrid.flow import listed_product, tall_product
from servotwin.hybrid.tables import VECTOR, padded, zeros

FINE = 8
"""Intervals of the fine scale, one tick each; and ticks of an interval of the coarse scale."""
COARSE = 16
"""Intervals of the coarse scale, and of the vast one."""
BLOCK = FINE * COARSE
"""Ticks of a coarse block, and of an interval of the vast scale."""
# Rounding of a product with a row, of the sum of its terms' sizes, in units of `SIGNIFICANT`.
_ROUNDING = 0.01


class LiftedTables(NamedTuple):
    """Flat tables of `S` slots, `N` states, `W` watches each; rows of a level: per watch the values at the
    ends, the thirds of the slopes at the beginnings and at the ends of its intervals, and its deviation's matrix.

    Jumps stand side by side, so that one product gives the states at all ends: ``[slot, state, power, new state]``."""

    states: int
    watches: int
    fine: Array  # S * N * padded(W * (3 * 8 + 1 + N))
    coarse: Array  # S * N * padded(W * (3 * 16 + 1 + N))
    vast: Array  # the same, filled only where a run is calm for long
    jump_fine: Array  # S * N * 8 * N: M**j - I, j = 1 .. 8
    jump_coarse: Array  # S * N * 16 * N: M**(8 j) - I
    jump_vast: Array  # S * N * 16 * N: M**(128 j) - I
    sizes: Array  # S * W * N: a watch below this part of abs(z) times `SIGNIFICANT` is rounding
    vast_sizes: Array  # the same on the vast scale
    settling: Array  # S * N * N: M**k - I after two million ticks
    uneven: Array  # S * N: 1.0 for a state of which something is left then that does not move evenly


class LiftedWorkspace(NamedTuple):
    """Working memory to fill a slot; matrices are row-major, those of many watches side by side."""

    moving: NDArray[np.int64]  # N: first the states that the map moves, whose rows of M - I are not zero
    movers: NDArray[np.int64]  # 1: how many
    map: Array  # N * N: M - I
    values: Array  # W * N: rows of the watches at a tick
    starts: Array  # W * N: thirds of their slopes over a tick, at its beginning
    ends: Array  # W * N: and at its end, of the state there
    sizes: Array  # W * N: sizes of all terms that enter a watch
    discrete: Array  # W: 1.0 where the watch counts at ticks only
    inside: Array  # W * N * N: squares of the deviation from the cubic within one tick
    powers: Array  # N * 16 * N: those of one scale side by side, [row, power, column]
    rows: Array  # 3 * 17 * N: values, starts and ends at the ends of the intervals
    row: Array
    sums: Array  # N * W * N: [row, watch, column]
    half: Array  # N * W * N
    turned: Array  # N * W * N
    product: Array  # N * N
    deviations: Array  # 3 * 16 * N: those from one cubic, at the control points of every interval
    column: Array  # 3 * 16


def lifted_counts(states: int, watches: int, slots: int) -> tuple[int, ...]:
    """Numbers in each table of so many slots."""
    n2 = states * states
    sizes = (
        states * row_count(states, watches, FINE),
        states * row_count(states, watches, COARSE),
        states * row_count(states, watches, COARSE),
        FINE * n2,
        COARSE * n2,
        COARSE * n2,
        watches * states,
        watches * states,
        n2,
        states,
    )
    return tuple(slots * size for size in sizes)


def lifted_in(arrays: Sequence[Array], states: int, watches: int) -> LiftedTables:
    """Tables in arrays of `lifted_counts`, whatever these hold: none is filled yet."""
    return LiftedTables(states, watches, *arrays)


def new_lifted_workspace(states: int, watches: int) -> LiftedWorkspace:
    """Working memory to fill slots."""
    n, n2 = states, states * states
    rows = (watches * n,) * 4
    points = 3 * COARSE
    sizes = (n2, *rows, watches, watches * n2, COARSE * n2, (points + 3) * n, n, *(watches * n2,) * 3, n2)
    whole = np.zeros((2, max(n, 1)), dtype=np.int64)
    return LiftedWorkspace(whole[0], whole[1, :1], *(zeros(size) for size in (*sizes, points * n, points)))


def row_count(states: int, watches: int, intervals: int) -> int:
    """Columns of the table of a level."""
    return padded(watches * (3 * intervals + 1 + states))


@inlined
def level_stride(t: LiftedTables, intervals: int) -> int:
    return (t.watches * (3 * intervals + 1 + t.states) + VECTOR - 1) // VECTOR * VECTOR


@subroutine
def add_square(n: int, row: Array, sums: Array, base: int, stride: int) -> None:
    """Add ``row' row`` to a matrix whose rows are `stride` apart."""
    for i in range(n):
        factor = row[i]
        if factor != 0.0:
            at = base + i * stride
            for j in range(n):
                sums[at + j] += factor * row[j]


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


@subroutine
def find_moving(n: int, w: LiftedWorkspace) -> None:
    """List the states that the map moves: all products below leave out the others, whose rows are zero in every
    power."""
    w.movers[0] = 0
    for i in range(n):
        size = 0.0
        for j in range(n):
            size += abs(w.map[i * n + j])
        # Also without numbers.
        if size != 0.0:
            w.moving[w.movers[0]] = i
            w.movers[0] += 1


@subroutine
def _fill_powers(n: int, intervals: int, w: LiftedWorkspace) -> None:
    """The powers of a scale from its first, as deviations from one; each round makes as many as there were."""
    u, stride, known = w.powers, intervals * n, 1
    moving = w.moving[: w.movers[0]]
    row = w.row[: moving.size]
    mover = 0
    for i in range(n):
        if mover < moving.size and moving[mover] == i:
            mover += 1
        else:
            for j in range(i * stride, (i + 1) * stride):
                u[j] = 0.0
    while known < intervals:
        # The last one times all of them: D_a + (I + D_a) D_b.
        last = (known - 1) * n
        for i in moving:
            at = i * stride
            for k in range(n):
                w.product[k] = u[at + last + k]
            for k in range(moving.size):
                row[k] = w.product[moving[k]] + (1.0 if moving[k] == i else 0.0)
            to = at + known * n
            # By way of another array: what it reads and writes side by side would not be vectorised.
            new = w.rows[: known * n]
            listed_product(u, 0, stride, known * n, moving, row, new)
            for j in range(known):
                for k in range(np.uint64(n)):
                    u[to + j * n + k] = new[j * n + k] + w.product[k]
        known *= 2


@subroutine
def _store_jumps(n: int, intervals: int, table: Array, slot: int, w: LiftedWorkspace) -> None:
    stride = intervals * n
    begin = slot * n * stride
    for at in range(begin, begin + n * stride):
        table[at] = 0.0
    for k in w.moving[: w.movers[0]]:
        for j in range(intervals):
            for i in range(n):
                table[begin + i * stride + j * n + k] = w.powers[k * stride + j * n + i]


@subroutine
def _double(n: int, intervals: int, power: int, watches: int, w: LiftedWorkspace) -> None:
    """``G + M' G M`` of every watch for the power of ``M`` at that place: the sums over twice as many intervals."""
    stride, width = intervals * n, watches * n
    moving = w.moving[: w.movers[0]]
    row = w.row[: moving.size]
    for i in range(n):
        for k in range(moving.size):
            row[k] = w.powers[moving[k] * stride + power * n + i]
        half = w.half[i * width : (i + 1) * width]
        listed_product(w.sums, 0, width, width, moving, row, half)
        for j in range(width):
            half[j] += w.sums[i * width + j]
    # M' G, turned over, is G M, for G is symmetric.
    for i in range(n):
        for watch in range(watches):
            for k in range(n):
                w.turned[k * width + watch * n + i] = w.half[i * width + watch * n + k]
    for i in range(n):
        for k in range(moving.size):
            row[k] = w.powers[moving[k] * stride + power * n + i]
        half = w.half[i * width : (i + 1) * width]
        listed_product(w.turned, 0, width, width, moving, row, half)
        for j in range(width):
            w.sums[i * width + j] += half[j] + w.turned[i * width + j]


@subroutine
def _fill_rows(n: int, intervals: int, watch: int, w: LiftedWorkspace) -> None:
    """Value row, start row and end row of a watch at all ends of the intervals, into `rows`."""
    stride = intervals * n
    moving = w.moving[: w.movers[0]]
    part = w.row[: moving.size]
    for kind in range(3):
        source = w.values if kind == 0 else (w.starts if kind == 1 else w.ends)
        row, first = source[watch * n : (watch + 1) * n], kind * (COARSE + 1) * n
        for k in range(moving.size):
            part[k] = row[moving[k]]
        listed_product(w.powers, 0, stride, stride, moving, part, w.rows[first + n : first + n + stride])
        for k in range(n):
            w.rows[first + k] = row[k]
        for j in range(1, intervals + 1):
            for k in range(n):
                w.rows[first + j * n + k] += row[k]


@subroutine
def _fill_level(
    t: LiftedTables,
    table: Array,
    sizes: Array,
    slot: int,
    watch: int,
    watches: int,
    intervals: int,
    length: float,
    w: LiftedWorkspace,
) -> None:
    """Rows of one watch at one scale, and its deviation's matrix from `sums`; `length` of an interval in ticks."""
    n, stride, starts = t.states, level_stride(t, intervals), (COARSE + 1) * t.states
    at = slot * n * stride + watch * (3 * intervals + 1 + n)
    for j in range(n):
        column, largest = at + j * stride, 0.0
        for i in range(intervals + 1):
            value = w.rows[i * n + j]
            table[column + i] = value
            largest = max(largest, abs(value))
        size = (slot * t.watches + watch) * n + j
        sizes[size] = max(sizes[size], _ROUNDING * largest)
        column += intervals + 1
        for i in range(intervals):
            table[column + i] = length * w.rows[starts + i * n + j]
        column += intervals
        for i in range(intervals):
            table[column + i] = length * w.rows[2 * starts + (i + 1) * n + j]
        column += intervals
        for i in range(n):
            table[column + i] = w.sums[(i * watches + watch) * n + j]


@subroutine
def add_deviation(
    n: int, watch: int, watches: int, intervals: int, length: float, only_ends: bool, w: LiftedWorkspace
) -> None:
    """Make the sums of one scale those of an interval of the next: add the squares of its cubics' deviation from the
    cubic over all of its intervals."""
    starts, ends = (COARSE + 1) * n, 2 * (COARSE + 1) * n
    whole, count, inner = intervals * length, 0, w.product
    for j in range(n):
        inner[j] = w.rows[j] + whole * w.rows[starts + j]
        inner[n + j] = w.rows[intervals * n + j] - whole * w.rows[ends + intervals * n + j]
    for i in range(intervals):
        for point in range(1, 4):
            if point < 3 and only_ends:
                continue
            u = (i if point == 1 else i + 1) / intervals
            side = 0.0 if point == 3 else (1.0 if point == 1 else -1.0)
            c0, c1, c2, c3 = cubic_weights(u, side / intervals)
            at, slope = (i if point == 1 else i + 1) * n, (starts + i * n if point == 1 else ends + (i + 1) * n)
            lean, to, last = side * length, count * n, intervals * n
            for j in range(np.uint64(n)):
                true = w.rows[at + j] + lean * w.rows[slope + j]
                cubic = (c0 * w.rows[j] + c1 * inner[j]) + (c2 * inner[n + j] + c3 * w.rows[last + j])
                w.deviations[to + j] = true - cubic
            count += 1
    for i in range(n):
        for k in range(count):
            w.column[k] = w.deviations[k * n + i]
        tall_product(w.deviations, 0, n, n, w.column[:count], w.row)
        for j in range(n):
            at = (i * watches + watch) * n + j
            # The square of a sum is at most twice the sum of the squares.
            w.sums[at] = 2.0 * (w.sums[at] + w.row[j])


@subroutine
def _rebase(n: int, intervals: int, following: int, w: LiftedWorkspace) -> None:
    """The last power of a scale becomes the first of the next, which has `following` intervals."""
    last = (intervals - 1) * n
    for i in range(n):
        for k in range(n):
            w.product[i * n + k] = w.powers[i * intervals * n + last + k]
    for i in range(n):
        for k in range(n):
            w.powers[i * following * n + k] = w.product[i * n + k]


@subroutine
def fill_scale(
    t: LiftedTables, table: Array, jumps: Array, sizes: Array, slot: int, watches: int, intervals: int, length: int,
    last: bool, w: LiftedWorkspace,
) -> None:  # fmt: skip
    """One scale, from the first of its powers and the sums of one interval; the sums become those of the next scale's
    interval, but for the last."""
    n = t.states
    _fill_powers(n, intervals, w)
    _store_jumps(n, intervals, jumps, slot, w)
    size = 0.0
    for i in range(n * watches * n):
        size += abs(w.sums[i])
    power = 1
    # A tick that is one step of the search is its cubic: nothing is to be summed.
    while size > 0.0 and power < intervals:
        _double(n, intervals, power - 1, watches, w)
        power *= 2
    for watch in range(watches):
        _fill_rows(n, intervals, watch, w)
        _fill_level(t, table, sizes, slot, watch, watches, intervals, float(length), w)
        if not last:
            add_deviation(n, watch, watches, intervals, float(length), length == 1 and w.discrete[watch] > 0.0, w)


@subroutine
def fill_slot(t: LiftedTables, slot: int, watches: int, w: LiftedWorkspace) -> None:
    """The tables of the map and the watches in `w`, but for those of the vast scale."""
    n, n2 = t.states, t.states * t.states
    for watch in range(watches):
        for i in range(n):
            t.sizes[(slot * t.watches + watch) * n + i] = w.sizes[watch * n + i]
            for j in range(n):
                w.sums[(i * watches + watch) * n + j] = w.inside[watch * n2 + i * n + j]
    for i in range(n):
        for k in range(n):
            w.powers[i * FINE * n + k] = w.map[i * n + k]
    find_moving(n, w)
    # Literals would have the function compiled once for each.
    fill_scale(t, t.fine, t.jump_fine, t.sizes, slot, watches, int(FINE), 1, False, w)
    _rebase(n, int(FINE), int(COARSE), w)
    fill_scale(t, t.coarse, t.jump_coarse, t.sizes, slot, watches, int(COARSE), int(FINE), True, w)
