"""Use of a sampled loop's blocks: how far a block is clean, and the state after it; `lifted` fills their tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import inlined, subroutine
from servotwin.hybrid.flow import SIGNIFICANT, dot, dot_sizes, product, tall_product, wide_product
from servotwin.hybrid.lifted import COARSE, LiftedTables, level_stride
from servotwin.hybrid.tables import VECTOR


@inlined
def clean_part(
    t: LiftedTables, sizes: Array, slot: int, watches: int, intervals: int, limit: int, low: Array, high: Array,
    slack: Array, less: float, squares: Array, z: Array, out: Array,
) -> int:  # fmt: skip
    """Number of intervals, at most `limit`, before the first in which some watch may leave its bounds."""
    clean: Any = limit  # as in `clean_intervals`: int64 in every branch
    for watch in range(watches):
        size = dot_sizes(sizes, (slot * t.watches + watch) * t.states, z)
        room = (slack[watch] - less) * (SIGNIFICANT * size) - math.sqrt(max(squares[watch], 0.0))
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
                    clean = np.int64(k)
                    break
    return clean


@subroutine
def settled_squares(
    t: LiftedTables, table: Array, slot: int, watches: int, intervals: int, z: Array, way: Array, squares: Array
) -> bool:
    """Squares of every watch's deviation, from the state's way to rest, which goes into `way`: at rest nothing
    deviates. False where the state does not come to rest."""
    n, stride = t.states, level_stride(t, intervals)
    if dot_sizes(t.uneven, slot * n, z) > 0.0:
        return False
    for i in range(n):
        way[i] = dot(t.settling, (slot * n + i) * n, z)
    for watch in range(watches):
        square, at = 0.0, slot * n * stride + watch * (3 * intervals + 1 + n) + 3 * intervals + 1
        for j in range(n):
            # The matrix is symmetric.
            square += way[j] * dot(table, at + j * stride, way)
        squares[watch] = square
    return True


@inlined
def clean_ticks(
    t: LiftedTables, table: Array, sizes: Array, slot: int, watches: int, intervals: int, limit: int, low: Array,
    high: Array, slack: Array, settles: bool, squares: Array, change: Array, z: Array, out: Array,
) -> int:  # fmt: skip
    """Number of intervals of a block, at most `limit`, before the first in which some watch may leave its bounds.

    With `settles` the squares of the deviations are taken a second time where they are too large, from the state's way
    to where it rests or moves evenly: near rest those of the state are rounding, whose root is far above that of a
    watch.
    """
    stride = level_stride(t, intervals)
    used = (watches * (3 * intervals + 1 + t.states) + VECTOR - 1) // VECTOR * VECTOR
    if t.states == 16:
        wide_product(table, slot * t.states * stride, stride, used, z, out)
    else:
        tall_product(table, slot * t.states * stride, stride, used, z, out)
    clean, less, n = 0, 0.0, np.uint64(t.states)
    for watch in range(watches):
        square, at = 0.0, np.uint64(watch * (3 * intervals + 1 + t.states) + 3 * intervals + 1)
        for i in range(n):
            square += out[at + i] * z[i]
        squares[watch] = square
    for attempt in range(2):
        if attempt == 1:
            if not settled_squares(t, table, slot, watches, intervals, z, change, squares):
                break
            # What rests deviates by rounding only.
            less = 1.0
        clean = clean_part(t, sizes, slot, watches, intervals, limit, low, high, slack, less, squares, z, out)
        if clean == limit or not settles:
            break
    return clean


@inlined
def jump(n: int, jumps: Array, slot: int, intervals: int, clean: int, z: Array, change: Array) -> None:
    """Advance by some intervals of a scale, at least one."""
    product(jumps, (slot * n * intervals + clean - 1) * n, intervals * n, n, z, change)
    for i in range(np.uint64(n)):
        z[i] += change[i]


@inlined
def changes_at_ends(n: int, jumps: Array, slot: int, z: Array, out: Array) -> None:
    """Changes of the state up to the end of each interval of the vast scale, one after the other."""
    if n == 16:
        wide_product(jumps, slot * n * COARSE * n, COARSE * n, COARSE * n, z, out)
    else:
        tall_product(jumps, slot * n * COARSE * n, COARSE * n, COARSE * n, z, out)
