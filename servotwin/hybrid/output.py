"""Outputs of a recorded run: at every sample of a grid, or at any time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare
from servotwin.hybrid.flow import Scratch, advance, advance_fraction, dot, product
from servotwin.hybrid.tables import NODES_COARSE, NODES_FINE, Tables

_BLOCK = NODES_COARSE * NODES_FINE


class Outputs(NamedTuple):
    """How one output follows from the state at the start of a segment, up to 127 steps later."""

    table: Array  # M * 128 * n, or M * n * 128 for the states in `order`
    order: NDArray[np.int64]  # (M, n) states, those that count first
    used: NDArray[np.int64]  # (M,) number of those that count


def output_table(tables: Tables, rows: Array, stride: int) -> Outputs:
    """Rows ``rows[m] @ exp(A_m j h)`` for j = 0 .. 127, flat: ``(M, n, 128)`` for every step, ``(M, 128, n)`` for a
    few."""
    n, modes = tables.states, len(tables.guard_count)
    # Stored transposed: [m, j, k, i] is element (i, k) of the deviation.
    fine = tables.jump_fine.reshape(-1, NODES_FINE, n, n)[tables.flow_of]
    coarse = tables.jump_coarse.reshape(-1, NODES_COARSE, n, n)[tables.flow_of]
    eights = rows[:, None] + np.einsum("mjki,mi->mjk", coarse[:, :-1], rows)
    starts = np.concatenate([rows[:, None], eights], axis=1)
    ones = starts[:, :, None] + np.einsum("mjki,mli->mljk", fine[:, :-1], starts)
    table = np.concatenate([starts[:, :, None], ones], axis=2).reshape(modes, _BLOCK, n)
    counts = np.abs(table).max(axis=1) > 0.0
    order, used = np.argsort(~counts, axis=1, kind="stable"), counts.sum(axis=1)
    if stride > 1:
        return Outputs(table.ravel(), order, used)
    columns = np.take_along_axis(table.transpose(0, 2, 1), order[:, :, None], axis=1)
    return Outputs(np.ascontiguousarray(columns).ravel(), order, used)


@bare
def sample_segments(
    begin: int,
    size: int,
    step: NDArray[np.int64],
    fraction: Array,
    mode: NDArray[np.int64],
    state: Array,
    outputs: Outputs,
    stride: int,
    first: int,
    chosen: Array,
    out: Array,
) -> None:
    """Write the output at samples `first` on, one every `stride` search steps, from the segments that start on the
    grid. `chosen` is working memory for one state."""
    table = outputs.table
    n, last = state.shape[1], first + len(out)
    for s in range(begin, size):
        if fraction[s] > 0.0:
            continue
        end = step[s] + 1
        if s + 1 < size:
            end = step[s + 1] + (1 if fraction[s + 1] > 0.0 else 0)
        low, high = max(first, -(-step[s] // stride)), min(last, -(-end // stride))
        if high <= low:
            if low >= last:
                break
            continue
        at, offset = mode[s] * n * _BLOCK, low * stride - step[s]
        if stride == 1:
            used = outputs.used[mode[s]]
            for j in range(np.uint64(used)):
                chosen[j] = state[s, outputs.order[mode[s], j]]
            product(table, at + offset, _BLOCK, high - low, chosen[:used], out[low - first : high - first])
        else:
            for sample in range(low, high):
                out[sample - first] = dot(table, at + (sample * stride - step[s]) * n, state[s])


@bare
def evaluate(
    t: Tables,
    segments: NDArray[np.int64],
    offsets: Array,
    mode: NDArray[np.int64],
    state: Array,
    rows: Array,
    out: Array,
    x: Array,
    scratch: Scratch,
) -> None:
    """Dense output: advance each segment's start by an offset in steps and apply the row of its mode."""
    n2 = t.states * t.states
    for k in range(len(segments)):
        m = mode[segments[k]]
        flow = t.flow_of[m]
        for i in range(t.states):
            x[i] = state[segments[k], i]
        whole = int(offsets[k])
        eights, ones = min(whole // NODES_FINE, NODES_COARSE), 0
        ones = min(whole - eights * NODES_FINE, NODES_FINE)
        if eights > 0:
            advance(t.jump_coarse, (flow * NODES_COARSE + eights - 1) * n2, x, scratch.change)
        if ones > 0:
            advance(t.jump_fine, (flow * NODES_FINE + ones - 1) * n2, x, scratch.change)
        advance_fraction(t, m, x, offsets[k] - whole, scratch)
        total = 0.0
        for i in range(t.states):
            total += rows[m, i] * x[i]
        out[k] = total
