"""Outputs of a sampled run that was recorded as blocks of ticks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, subroutine
from servotwin.hybrid.flow import dot, product, tall_product
from servotwin.hybrid.lifted import BLOCK, COARSE, FINE, LiftedTables, LiftedWorkspace
from servotwin.hybrid.lifted_blocks import changes_at_ends
from servotwin.simulation.lifted import TICKED, VAST, Segments
from servotwin.simulation.lifted_tables import LiftedMemory, Places


@inlined
def _at(sample: int, state: int, n: int, samples_first: bool) -> int:
    return state * BLOCK + sample if samples_first else sample * n + state


@subroutine
def _fill_output(
    lifted: LiftedTables, w: LiftedWorkspace, slot: int, row: Array, samples_first: bool, out: Array
) -> None:
    """Rows ``row M**j`` for j = 0 .. 127, one after the other, or sample after sample in each column."""
    n, fine, coarse = lifted.states, FINE * lifted.states, COARSE * lifted.states
    rest = fine - n
    # Powers 1 .. 7 of the map, whose rows the jumps hold as columns.
    for i in range(n):
        for j in range(FINE - 1):
            for k in range(n):
                w.powers[i * rest + j * n + k] = lifted.jump_fine[(slot * n + k) * fine + j * n + i]
    start, rows = w.row[:n], w.rows[:rest]
    for c in range(COARSE):
        for k in range(n):
            start[k] = row[k]
            if c > 0:
                start[k] += dot(lifted.jump_coarse, (slot * n + k) * coarse + (c - 1) * n, row)
            out[_at(c * FINE, k, n, samples_first)] = start[k]
        tall_product(w.powers, 0, rest, rest, start, rows)
        for j in range(1, FINE):
            for k in range(n):
                out[_at(c * FINE + j, k, n, samples_first)] = start[k] + rows[(j - 1) * n + k]


@inlined
def _sample(table: Array, base: int, begin: int, stop: int, stride: int, z: Array, out: Array) -> None:
    """Samples from tick `begin`, where the state is `z`, up to `stop`, at most a block later."""
    first, last = -(-begin // stride), -(-stop // stride)
    if stride > 1:
        for sample in range(first, last):
            out[sample] = dot(table, base + (sample * stride - begin) * z.size, z)
    elif last > first:
        tall_product(table, base, BLOCK, last - first, z, out[first:last])


@subroutine
def _prepare(
    memory: LiftedMemory, places: Places, slot: int, row: Array, stride: int, filled: NDArray[np.int8], table: Array
) -> None:
    """Fill the table of an output in a slot, where that was not done yet."""
    n = places.states
    base, whole = slot * BLOCK * n, memory.change
    if filled[slot] == 0:
        for j in range(n):
            whole[j] = row[j] if j != places.voltage else 0.0
        for j in range(n):
            whole[j] += row[places.voltage] * memory.voltage_rows[slot * n + j]
        _fill_output(memory.lifted, memory.workspace, slot, whole, stride == 1, table[base : base + BLOCK * n])
        filled[slot] = 1


@subroutine
def _sample_states(
    memory: LiftedMemory, places: Places, slot: int, rows: Array, begin: int, stop: int, stride: int, start: Array,
    traces: Array,
) -> None:  # fmt: skip
    """Samples by way of the state at each of them: for few samples the tables of the outputs do not pay."""
    n, lifted = places.states, memory.lifted
    z, change = memory.out[:n], memory.out[n : 2 * n]
    for sample in range(-(-begin // stride), -(-stop // stride)):
        coarse, fine = divmod(sample * stride - begin, FINE)
        for i in range(n):
            z[i] = start[i]
        if coarse > 0:
            product(lifted.jump_coarse, (slot * n * COARSE + coarse - 1) * n, COARSE * n, n, start, change)
            for i in range(n):
                z[i] += change[i]
        if fine > 0:
            product(lifted.jump_fine, (slot * n * FINE + fine - 1) * n, FINE * n, n, z, change)
            for i in range(n):
                z[i] += change[i]
        # The tick changes the voltage alone of all that outputs read.
        voltage = 0.0
        for i in range(n):
            voltage += memory.voltage_rows[slot * n + i] * z[i]
        z[places.voltage] = voltage
        for o in range(len(rows)):
            traces[o, sample] = dot(rows[o], 0, z)


@bare
def sample_lifted(
    segments: Segments,
    memory: LiftedMemory,
    places: Places,
    rows: Array,
    end: int,
    stride: int,
    filled: NDArray[np.int8],
    tables: Array,
    traces: Array,
) -> None:
    """``rows @ z`` after the tick, at every `stride`-th tick up to `end`; `tables` and `filled` have room for every
    output and slot and hold those filled before."""
    n, size, outputs = places.states, segments.size[0], len(rows)
    for s in range(size):
        begin = segments.tick[s]
        stop = segments.tick[s + 1] if s + 1 < size else end
        first, last = -(-begin // stride), -(-stop // stride)
        if last <= first:
            continue
        slot, start, z = segments.slot[s], segments.state[s], memory.change
        if slot == TICKED:
            for o in range(outputs):
                traces[o, first] = dot(rows[o], 0, start)
            continue
        if stride > 1 and slot >= 0 and memory.vast[slot] == 0:
            _sample_states(memory, places, slot, rows, begin, stop, stride, start, traces)
            continue
        parts = 1
        if slot <= VAST:
            slot, parts = VAST - slot, -(-(stop - begin) // BLOCK)
        for o in range(outputs):
            _prepare(memory, places, slot, rows[o], stride, filled[o], tables[o])
        if parts > 1:
            changes_at_ends(n, memory.lifted.jump_vast, slot, start, memory.out)
        for part in range(parts):
            for i in range(np.uint64(n)):
                z[i] = start[i]
                if part > 0:
                    z[i] += memory.out[np.uint64(part - 1) * np.uint64(n) + i]
            for o in range(outputs):
                at = begin + part * BLOCK
                _sample(tables[o], slot * BLOCK * n, at, min(stop, at + BLOCK), stride, z, traces[o])
