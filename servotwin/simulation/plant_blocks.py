"""The compiled sampled loop with the plant in blocks of eight ticks and the deployed law at every one of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control.law import LawParameters, LawState
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, subroutine
from servotwin.hybrid.flow import Scratch
from servotwin.hybrid.kernel import DONE, FULL, ZENO, RunRecord, step_once
from servotwin.hybrid.response import (
    TICKS,
    BlockResponses,
    ResponseMemory,
    advance_block,
    begin_block,
    calm_ticks,
    end_block,
    hold_input,
)
from servotwin.hybrid.tables import Tables
from servotwin.simulation.ticks import Output, Port, TickInputs, in_turn, measured, tick_between

_UNNOTED = 64
"""Blocks after which a start is recorded anew: `sample_blocks` makes the states between, up to rounding."""


class PlantBlocks(NamedTuple):
    """Growing record of starts of blocks that follow one another in one mode; ``size[0]`` are filled."""

    size: NDArray[np.int64]
    tick: NDArray[np.int64]
    mode: NDArray[np.int64]
    state: Array  # the input left out


def new_blocks(states: int, room: int) -> PlantBlocks:
    """An empty record."""
    return PlantBlocks(
        np.zeros(1, dtype=np.int64),
        np.empty(room, dtype=np.int64),
        np.empty(room, dtype=np.int64),
        np.empty((room, states)),
    )


def more_blocks(blocks: PlantBlocks) -> PlantBlocks:
    """A copy with twice the room."""
    larger = new_blocks(blocks.state.shape[1], 2 * len(blocks.tick))
    for old, new in zip(blocks, larger, strict=True):
        new[: len(old)] = old
    return larger


@bare
def note_block(blocks: PlantBlocks, tick: int, mode: int, x: Array) -> None:
    """Record the start of a block."""
    at = blocks.size[0]
    blocks.tick[at], blocks.mode[at] = tick, mode
    for i in range(np.uint64(x.size)):
        blocks.state[at, i] = x[i]
    blocks.size[0] = at + 1


@subroutine
def after_ticks(
    tick: int,
    count: int,
    parameters: LawParameters,
    state: LawState,
    tick_inputs: TickInputs,
    output: Output,
) -> LawState:
    """The law's state after the first ticks of a block, from that before it: they are taken once more."""
    for i in range(tick, tick + count):
        k = i - tick_inputs.first
        zone, reference = k & tick_inputs.zone_mask, tick_inputs.reference[k & tick_inputs.reference_mask]
        y = output.measured[i - output.first_tick]
        state = tick_between(parameters, tick_inputs.enter[zone], tick_inputs.leave[zone], state, reference, y)
    return state


@inlined
def take_ticks(
    r: BlockResponses,
    tick: int,
    count: int,
    mode: int,
    parameters: LawParameters,
    state: LawState,
    port: Port,
    tick_inputs: TickInputs,
    output: Output,
    memory: ResponseMemory,
    commands: Array,
    recent: float,
) -> LawState:
    """The ticks of a block, one after the other, as if no guard fired."""
    delay, soon, voltage, coming = port.delayed.size, r.next[mode], recent, memory.position[0]
    begin, row = tick - tick_inputs.first, tick - output.first_tick
    voltages, positions = output.states[0, row : row + count], output.states[1, row : row + count]
    measurements, actives = output.measured[row : row + count], output.active[row : row + count]
    for j in range(np.uint64(count)):
        # The newest voltage is added here, and the next position read before it is added there: through memory the
        # next tick would wait for it.
        position, coming = coming + soon * voltage, memory.position[j + np.uint64(1)]
        k = begin + int(j)
        zone = np.uint64(k & tick_inputs.zone_mask)
        y = measured(position, tick_inputs.noise[np.uint64(k & tick_inputs.noise_mask)], port)
        reference = tick_inputs.reference[np.uint64(k & tick_inputs.reference_mask)]
        state = tick_between(parameters, tick_inputs.enter[zone], tick_inputs.leave[zone], state, reference, y)
        voltage = commands[j] = state.voltage
        if delay > 0:
            early = int(j) < delay
            voltage = port.delayed[(tick + int(j)) % delay] if early else commands[int(j) - delay]
        voltages[j], positions[j], measurements[j] = voltage, position, y
        actives[j] = 1 if state.active > 0.5 else 0
        hold_input(r, mode, j, voltage, memory)
    return state


@bare
def run_plant_blocks(
    t: Tables,
    r: BlockResponses,
    x: Array,
    tick: int,
    end: int,
    mode: int,
    parameters: LawParameters,
    state: LawState,
    port: Port,
    tick_inputs: TickInputs,
    output: Output,
    record: RunRecord,
    blocks: PlantBlocks,
    scratch: Scratch,
    memory: ResponseMemory,
    commands: Array,
) -> tuple[int, int, int, LawState]:
    """Run ticks `tick` .. `end` - 1; return status, the next tick, mode and law state. Stops early when a record is
    full."""
    # A literal is a type of its own to numba: `begin_block` would be compiled once more for it.
    fresh: Any = np.bool_(True)
    recent, unnoted = 0.0, 0
    while tick < end:
        if record.size[1] > port.room or blocks.size[0] == len(blocks.tick):
            return FULL, tick, mode, state
        begin_block(r, mode, port.voltage, fresh, x, memory)
        if fresh or unnoted == _UNNOTED:
            note_block(blocks, tick, mode, x)
            unnoted = 0
        unnoted += 1
        count = min(TICKS, end - tick)
        for j in range(count, TICKS):
            memory.start[t.states + j] = 0.0
        before = state
        state = take_ticks(r, tick, count, mode, parameters, state, port, tick_inputs, output, memory, commands, recent)
        calm = calm_ticks(t, r, mode, count, x, memory)
        end_block(r, mode, calm, x, memory)
        last = min(calm, count - 1)
        if calm < count:
            state = after_ticks(tick, last + 1, parameters, before, tick_inputs, output)
            x[port.voltage] = output.states[0, tick + last - output.first_sample]
        for j in range(last + 1 if port.delayed.size > 0 else 0):
            in_turn(tick + j, commands[j], port.delayed)
        tick += calm
        fresh = calm < TICKS
        recent = 0.0 if fresh else output.states[0, tick - 1 - output.first_sample]
        if calm < count:
            # The tick in which a guard may fire: searched as in every other run.
            for search in range(tick * port.searches, (tick + 1) * port.searches):
                mode = step_once(t, mode, x, search, record, scratch)
                record.size[0] = 0
                if mode < 0:
                    return ZENO, tick, mode, state
            tick += 1
    return DONE, tick, mode, state


@bare
def sample_blocks(
    blocks: PlantBlocks,
    r: BlockResponses,
    free: Array,
    late: Array,
    voltages: Array,
    memory: ResponseMemory,
    out: Array,
) -> None:
    """An output at every tick, from its ``(M, 8, n)`` free responses and ``(M, 8)`` responses to the voltages."""
    n, count = free.shape[2], blocks.size[0]
    x, z = memory.start[:n], memory.start
    for b in range(count):
        tick, mode = blocks.tick[b], blocks.mode[b]
        end = blocks.tick[b + 1] if b + 1 < count else out.size
        for i in range(n):
            x[i] = blocks.state[b, i]
        while tick < end:
            for j in range(min(TICKS, end - tick)):
                z[n + j] = voltages[tick + j]
                value = 0.0
                for i in range(n):
                    value += free[mode, j, i] * x[i]
                for i in range(j + 1):
                    value += late[mode, j - i] * z[n + i]
                out[tick + j] = value
            tick += TICKS
            if tick < end:
                advance_block(r, mode, TICKS, x, memory)
