"""The vast scale of a sampled loop's blocks, for runs that are calm for long, and where their states come to rest."""

from __future__ import annotations

import math

from servotwin.hybrid.compiled import subroutine
from servotwin.hybrid.flow import SIGNIFICANT, listed_product
from servotwin.hybrid.lifted import (
    BLOCK,
    COARSE,
    FINE,
    LiftedTables,
    LiftedWorkspace,
    add_deviation,
    fill_scale,
    find_moving,
    level_stride,
)

# Of the vast block: two million ticks, after which all that decays is gone.
_DOUBLINGS, _GONE = 10, 1e-40
_EVEN = 1e-11  # of what the other states make a watch deviate: rounding


@subroutine
def _find_uneven(t: LiftedTables, slot: int, watches: int, w: LiftedWorkspace) -> None:
    """States from which the matrix in `product` makes others on which a watch deviates by more than rounding."""
    n, stride = t.states, level_stride(t, COARSE)
    sizes, row = w.powers[:n], w.powers[n : 2 * n]
    for j in range(n):
        t.uneven[slot * n + j] = 0.0
    for watch in range(watches):
        square = slot * n * stride + watch * (3 * COARSE + 1 + n) + 3 * COARSE + 1
        for j in range(n):
            sizes[j] = 0.0
        for k in range(n):
            own = math.sqrt(max(t.vast[square + k * stride + k], 0.0))
            size = SIGNIFICANT * t.vast_sizes[(slot * t.watches + watch) * n + k] + _EVEN * own
            for j in range(n):
                sizes[j] += size * abs(w.product[k * n + j])
        for i in range(n):
            for j in range(n):
                row[j] = 0.0
            for k in range(n):
                factor = t.vast[square + i * stride + k]
                for j in range(n):
                    row[j] += factor * w.product[k * n + j]
            scale = math.sqrt(max(t.vast[square + i * stride + i], 0.0))
            for j in range(n):
                # Also without numbers, where the powers have grown beyond all.
                if not abs(row[j]) <= scale * sizes[j]:
                    t.uneven[slot * n + j] = 1.0


@subroutine
def _find_settling(t: LiftedTables, slot: int, watches: int, w: LiftedWorkspace) -> None:
    """Find a high power of the map, from those of the vast scale in `w`, and the deviations that it leaves."""
    n, d, new = t.states, w.product, w.powers
    moving = w.moving[: w.movers[0]]
    part = w.half[: moving.size]
    for i in range(n):
        for k in range(n):
            d[i * n + k] = w.powers[(i + 1) * COARSE * n - n + k]
    for i in range(n * n):
        new[i] = d[i]
    for _ in range(_DOUBLINGS):
        for i in moving:
            for k in range(moving.size):
                part[k] = d[i * n + moving[k]]
            listed_product(d, 0, n, n, moving, part, w.row)
            for j in range(n):
                new[i * n + j] = 2.0 * d[i * n + j] + w.row[j]
        for i in moving:
            for j in range(n):
                d[i * n + j] = new[i * n + j]
    for i in range(n * n):
        t.settling[slot * n * n + i] = d[i]
        whole = d[i] + (1.0 if i // n == i % n else 0.0)
        d[i] = whole if abs(whole) > _GONE else 0.0
    _find_uneven(t, slot, watches, w)


@subroutine
def deepen_slot(t: LiftedTables, slot: int, watches: int, w: LiftedWorkspace) -> None:
    """The tables of the vast scale and of settling, from those of the coarse one and the watches in `w`."""
    n, stride, block = t.states, level_stride(t, COARSE), (COARSE + 1) * t.states
    find_moving(n, w)
    for i in range(n):
        for k in range(n):
            w.powers[i * COARSE * n + k] = t.jump_coarse[((slot * n + k + 1) * COARSE - 1) * n + i]
    for watch in range(watches):
        for j in range(n):
            size = (slot * t.watches + watch) * n + j
            t.vast_sizes[size] = t.sizes[size]
            at = (slot * n + j) * stride + watch * (3 * COARSE + 1 + n)
            for i in range(COARSE + 1):
                w.rows[i * n + j] = t.coarse[at + i]
            for i in range(COARSE):
                w.rows[block + i * n + j] = t.coarse[at + COARSE + 1 + i] / FINE
                w.rows[2 * block + (i + 1) * n + j] = t.coarse[at + 2 * COARSE + 1 + i] / FINE
            for i in range(n):
                w.sums[(i * watches + watch) * n + j] = t.coarse[at + 3 * COARSE + 1 + i]
        add_deviation(n, watch, watches, int(COARSE), float(FINE), False, w)
    fill_scale(t, t.vast, t.jump_vast, t.vast_sizes, slot, watches, int(COARSE), int(BLOCK), True, w)
    _find_settling(t, slot, watches, w)
