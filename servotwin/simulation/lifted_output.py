"""Outputs of a sampled run that was recorded as blocks of ticks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined
from servotwin.hybrid.flow import dot, product
from servotwin.hybrid.lifted import BLOCK, COARSE, FINE, LiftedTables
from servotwin.simulation.lifted import TICKED, Segments
from servotwin.simulation.lifted_tables import LiftedMemory, Places


@inlined
def _at(sample: int, state: int, n: int, samples_first: bool) -> int:
    return state * BLOCK + sample if samples_first else sample * n + state


@bare
def _fill_output(lifted: LiftedTables, slot: int, row: Array, samples_first: bool, out: Array) -> None:
    """Rows ``row M**j`` for j = 0 .. 127, one after the other, or sample after sample in each column."""
    n = lifted.states
    n2 = n * n
    for c in range(COARSE):
        for k in range(n):
            value = row[k]
            if c > 0:
                value += dot(lifted.jump_coarse, (slot * COARSE + c - 1) * n2 + k * n, row)
            out[_at(c * FINE, k, n, samples_first)] = value
    for c in range(COARSE):
        for j in range(1, FINE):
            base = (slot * FINE + j - 1) * n2
            for k in range(n):
                value = out[_at(c * FINE, k, n, samples_first)]
                for i in range(n):
                    value += lifted.jump_fine[base + k * n + i] * out[_at(c * FINE, i, n, samples_first)]
                out[_at(c * FINE + j, k, n, samples_first)] = value


@bare
def sample_lifted(
    segments: Segments,
    memory: LiftedMemory,
    places: Places,
    row: Array,
    end: int,
    stride: int,
    filled: NDArray[np.int8],
    table: Array,
    out: Array,
) -> None:
    """``row @ z`` after the tick, at every `stride`-th tick up to `end`; `table` and `filled` have room for every slot
    and hold those filled before."""
    n, size = places.states, segments.size[0]
    for s in range(size):
        begin = segments.tick[s]
        stop = segments.tick[s + 1] if s + 1 < size else end
        first, last = -(-begin // stride), -(-stop // stride)
        if last <= first:
            continue
        slot, z = segments.slot[s], segments.state[s]
        if slot == TICKED:
            out[first] = dot(row, 0, z)
            continue
        base = slot * BLOCK * n
        if filled[slot] == 0:
            whole = memory.change
            for j in range(n):
                whole[j] = row[j] if j != places.voltage else 0.0
            for j in range(n):
                whole[j] += row[places.voltage] * memory.voltage_rows[slot * n + j]
            _fill_output(memory.lifted, slot, whole, stride == 1, table[base : base + BLOCK * n])
            filled[slot] = 1
        if stride == 1:
            product(table, base, BLOCK, last - first, z, out[first:last])
        else:
            for sample in range(first, last):
                out[sample] = dot(table, base + (sample * stride - begin) * n, z)
