"""Outputs of a recorded run: at every sample of a grid, or at any time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, subroutine
from servotwin.hybrid.flow import Scratch, advance, advance_fraction, dot, product
from servotwin.hybrid.tables import NODES_COARSE, NODES_FINE, Tables, zeros

_BLOCK = NODES_COARSE * NODES_FINE


class Outputs(NamedTuple):
    """Table of one output: from the state at the start of a segment to the output up to 127 steps later."""

    table: Array  # M * 128 * n, or M * n * 128 for the states in `order`
    place: NDArray[np.int64]  # (M,) mode whose rows these are: modes of equal flow and row share them; -1: none yet
    order: NDArray[np.int64]  # (M, n) states, those that count first
    used: NDArray[np.int64]  # (M,) number of those that count


class OutputWorkspace(NamedTuple):
    """Working memory of `fill_output`."""

    starts: Array
    jump: Array
    rows: Array


def new_output_workspace(states: int) -> OutputWorkspace:
    """Working memory for outputs of so many states."""
    return OutputWorkspace(zeros(NODES_COARSE * states), zeros(states * states), zeros(_BLOCK * states))


def empty_outputs(tables: Tables, *count: int) -> Outputs:
    """Room for one output, or for `count` of them; no mode is filled."""
    n, modes = tables.states, len(tables.guard_count)
    table = zeros(math.prod(count) * modes * _BLOCK * n).reshape(*count, modes * _BLOCK * n)
    place, used = np.full((*count, modes), -1), np.zeros((*count, modes), dtype=np.int64)
    return Outputs(table, place, np.zeros((*count, modes, n), dtype=np.int64), used)


@inlined
def _equal(rows: Array, one: int, other: int, n: int) -> bool:
    different = 0
    for i in range(n):
        different += rows[one + i] != rows[other + i]
    return different == 0


@bare
def _fill_rows(t: Tables, flow: int, row: Array, w: OutputWorkspace) -> None:
    """``row @ exp(A j h)`` for all j: to every eighth step, and on from each of those."""
    n = t.states
    for k in range(n):
        w.starts[k] = row[k]
        for c in range(1, NODES_COARSE):
            w.starts[c * n + k] = row[k] + dot(t.jump_coarse, ((flow * NODES_COARSE + c - 1) * n + k) * n, row)
    for j in range(NODES_FINE):
        base = (flow * NODES_FINE + j - 1) * n * n
        for i in range(n):
            for k in range(n):
                # The tables hold deviations transposed.
                w.jump[i * n + k] = t.jump_fine[base + k * n + i] if j > 0 else 0.0
        for c in range(NODES_COARSE):
            start, to = w.starts[c * n : (c + 1) * n], w.rows[(c * NODES_FINE + j) * n : (c * NODES_FINE + j + 1) * n]
            product(w.jump, 0, n, n, start, to)
            for k in range(n):
                to[k] += start[k]


@subroutine
def _lay_out(m: int, n: int, stride: int, outputs: Outputs, w: OutputWorkspace) -> None:
    """Rows as sampling needs them: whole ones, or for every step the columns that are not zero."""
    base = m * _BLOCK * n
    # A few samples: one row each. Every sample: column by column, so that one product gives many samples.
    if stride > 1:
        for i in range(_BLOCK * n):
            outputs.table[base + i] = w.rows[i]
        return
    used, last = 0, n - 1
    for k in range(n):
        size = 0.0
        for j in range(_BLOCK):
            size += abs(w.rows[j * n + k])
        if size > 0.0:
            outputs.order[m, used] = k
            for j in range(_BLOCK):
                outputs.table[base + used * _BLOCK + j] = w.rows[j * n + k]
            used += 1
        else:
            outputs.order[m, last] = k
            last -= 1
    outputs.used[m] = used


@bare
def fill_output(t: Tables, m: int, rows: Array, stride: int, outputs: Outputs, w: OutputWorkspace) -> None:
    """Rows ``rows[m] @ exp(A_m j h)`` of a mode for j = 0 .. 127, flat: ``(M, n, 128)`` for every step, ``(M, 128, n)``
    for a few. Modes that are not filled have the place -1."""
    n = t.states
    for k in range(len(t.guard_count)):
        if outputs.place[k] == k and t.flow_of[k] == t.flow_of[m] and _equal(rows, k * n, m * n, n):
            outputs.place[m] = k
            return
    outputs.place[m] = m
    _fill_rows(t, t.flow_of[m], rows[m * n : (m + 1) * n], w)
    _lay_out(m, n, stride, outputs, w)


def output_table(tables: Tables, rows: Array, stride: int) -> Outputs:
    """The output ``rows[m] @ x``, `rows` being (M, n), at every `stride`-th step."""
    outputs, flat, w = empty_outputs(tables), np.array(rows, dtype=float).ravel(), new_output_workspace(tables.states)
    for mode in range(len(rows)):
        fill_output(tables, mode, flat, stride, outputs, w)
    return outputs


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
        place = outputs.place[mode[s]]
        at, offset = place * n * _BLOCK, low * stride - step[s]
        if stride == 1:
            used = outputs.used[place]
            for j in range(np.uint64(used)):
                chosen[j] = state[s, outputs.order[place, j]]
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
