"""The compiled half of the sampled loop: measure, tick, record, flow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control import law
from servotwin.control.law import LawParameters, LawState
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, verbatim
from servotwin.hybrid.flow import Scratch
from servotwin.hybrid.kernel import DONE, FULL, ZENO, RunRecord, step_once
from servotwin.hybrid.tables import NODES_FINE, VECTOR, Tables, aligned, padded

tick = verbatim(law.tick)


class Port(NamedTuple):
    """Indices of the plant states that the sampled loop reads and writes, and the division of its steps."""

    voltage: int
    position: int
    resolution: float
    recorded: NDArray[np.int64]  # states written at every recorded step
    tick_every: int
    record_every: int
    searches: int  # search steps per base step
    room: int  # events after which the record counts as full
    delayed: Array  # (d,) voltages that are computed but not yet applied, tick i's at i % d; empty: no delay


class TickInputs(NamedTuple):
    """Inputs of the ticks from tick `first` on."""

    first: int
    reference: Array
    noise: Array
    enter: Array
    leave: Array


class Output(NamedTuple):
    """Buffers of what is recorded, from a sample and a tick on."""

    states: Array  # (recorded, samples)
    measured: Array  # (ticks,)
    active: NDArray[np.int8]  # (ticks,)
    first_sample: int
    first_tick: int


class WholeTick(NamedTuple):
    """Table of the flow from tick to tick where no guard becomes positive: per mode the flow's power and every guard's
    Bernstein rows over each search step. A stride of 0: search step by search step."""

    table: Array  # M * n * stride
    stride: int
    rows: NDArray[np.int64]  # (M,) those in use


def new_whole_tick(t: Tables, searches: int) -> WholeTick:
    """The table for so many search steps per base step, at most 8 of them."""
    n, modes = t.states, len(t.guard_count)
    rows = n + 4 * searches * t.guard_count
    stride = padded(int(rows.max()))
    table = np.zeros((modes, n, stride))
    single = t.single.reshape(modes, n, n + 4 * t.guards)
    jumps = t.jump_fine.reshape(-1, NODES_FINE, n, n)
    for m in range(modes):
        count, flow = t.guard_count[m], jumps[t.flow_of[m]]
        table[m, :, :n] = flow[searches - 1]
        for s in range(searches):
            power = flow[s - 1] + np.eye(n) if s else np.eye(n)
            at = n + 4 * s * count
            table[m, :, at : at + 4 * count] = power @ single[m, :, n : n + 4 * count]
    return WholeTick(aligned(table.ravel()), stride, rows)


def no_whole_tick() -> WholeTick:
    """No table: search step by search step."""
    return WholeTick(np.zeros(VECTOR), 0, np.zeros(1, dtype=np.int64))


@inlined
def whole_product(whole: WholeTick, mode: int, x: Array, out: Array) -> None:
    """The table of a mode times the state: all columns at once, so that `out` is stored once.

    With three masses the ninth state is the voltage, known last: it is added last.
    """
    step, n = np.uint64(whole.stride), np.uint64(x.size)
    a = np.uint64(mode) * n * step
    table, rows = whole.table, step
    b, c, d = a + step, a + step * np.uint64(2), a + step * np.uint64(3)
    e, f, g, h = a + step * np.uint64(4), b + step * np.uint64(4), c + step * np.uint64(4), d + step * np.uint64(4)
    i, j, k, m = e + step * np.uint64(4), f + step * np.uint64(4), g + step * np.uint64(4), h + step * np.uint64(4)
    x0, x1, x2, x3, x4, x5 = x[0], x[1], x[2], x[3], x[4], x[5]
    x6, x7, x9, x10, x11 = x[6], x[7], x[9], x[10], x[11]
    if n == np.uint64(12):
        x8 = x[8]
        for r in range(rows):
            first = (table[a + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)
            second = (table[e + r] * x4 + table[f + r] * x5) + (table[g + r] * x6 + table[h + r] * x7)
            third = table[j + r] * x9 + (table[k + r] * x10 + table[m + r] * x11)
            out[r] = ((first + second) + third) + table[i + r] * x8
    else:
        o, p = i + step * np.uint64(4), j + step * np.uint64(4)
        q, s = k + step * np.uint64(4), m + step * np.uint64(4)
        x12, x13, x14, x15, x8 = x[12], x[13], x[14], x[15], x[8]
        for r in range(rows):
            first = (table[a + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)
            second = (table[e + r] * x4 + table[f + r] * x5) + (table[g + r] * x6 + table[h + r] * x7)
            third = table[j + r] * x9 + (table[k + r] * x10 + table[m + r] * x11)
            fourth = (table[o + r] * x12 + table[p + r] * x13) + (table[q + r] * x14 + table[s + r] * x15)
            out[r] = ((first + second) + (third + fourth)) + table[i + r] * x8


@inlined
def flow_tick(
    t: Tables, whole: WholeTick, mode: int, x: Array, search: int, searches: int, record: RunRecord, scratch: Scratch
) -> int:
    """Flow over one base step; return the mode, -1 when Zeno."""
    if whole.stride > 0:
        out, n, rows = scratch.rows, np.uint64(t.states), np.uint64(whole.rows[mode])
        whole_product(whole, mode, x, out)
        positive = 0
        for r in range(n, rows):
            positive += out[r] > 0.0
        if positive == 0:
            for i in range(n):
                x[i] += out[i]
            return mode
    for _ in range(searches):
        mode = step_once(t, mode, x, search, record, scratch)
        search += 1
        record.size[0] = 0
        if mode < 0:
            break
    return mode


@inlined
def take_tick(
    i: int, x: Array, parameters: LawParameters, state: LawState, port: Port, tick_inputs: TickInputs, output: Output
) -> LawState:
    """Measure, tick, hold the voltage (that of `delayed.size` ticks ago)."""
    k = i - tick_inputs.first
    y = x[port.position] + tick_inputs.noise[k]
    if port.resolution > 0.0:
        y = np.round(y / port.resolution) * port.resolution
    now = LawParameters(
        parameters.Kp,
        parameters.integral_step,
        parameters.derivative_gain,
        parameters.filter_step,
        tick_inputs.enter[k],
        tick_inputs.leave[k],
        parameters.voltage_limit,
        parameters.rate_step,
        parameters.loop_step,
        parameters.tracking_step,
        parameters.feedforward,
        parameters.release_step,
    )
    state = tick(now, state, tick_inputs.reference[k], y)
    if port.delayed.size == 0:
        x[port.voltage] = state.voltage
    else:
        place = i % port.delayed.size
        x[port.voltage] = port.delayed[place]
        port.delayed[place] = state.voltage
    output.measured[i - output.first_tick] = y
    output.active[i - output.first_tick] = 1 if state.active > 0.5 else 0
    return state


@inlined
def write_sample(row: int, x: Array, port: Port, output: Output) -> None:
    """Record the states of one sample."""
    for j in range(len(port.recorded)):
        output.states[j, row - output.first_sample] = x[port.recorded[j]]


@bare
def tick_and_record(
    base: int, x: Array, parameters: LawParameters, state: LawState, port: Port, tick_inputs: TickInputs, output: Output
) -> LawState:
    """Tick and record where they are due at a base step, before the plant flows on."""
    if base % port.tick_every == 0:
        state = take_tick(base // port.tick_every, x, parameters, state, port, tick_inputs, output)
    if base % port.record_every == 0:
        write_sample(base // port.record_every, x, port, output)
    return state


@bare
def run_ticks(
    t: Tables,
    x: Array,
    base: int,
    end: int,
    mode: int,
    parameters: LawParameters,
    state: LawState,
    port: Port,
    tick_inputs: TickInputs,
    output: Output,
    record: RunRecord,
    scratch: Scratch,
    whole: WholeTick,
) -> tuple[int, int, int, LawState]:
    """Run base steps `base` .. `end` - 1; return status, the next base step, mode and law state. Stops early when
    `record` is full."""
    i, row = (base - 1) // port.tick_every + 1, (base - 1) // port.record_every + 1
    to_tick, to_record = i * port.tick_every - base, row * port.record_every - base
    search = base * port.searches
    while base < end:
        if record.size[1] > port.room:
            return FULL, base, mode, state
        if to_tick == 0:
            state = take_tick(i, x, parameters, state, port, tick_inputs, output)
            to_tick = port.tick_every
            i += 1
        if to_record == 0:
            write_sample(row, x, port, output)
            to_record = port.record_every
            row += 1
        mode = flow_tick(t, whole, mode, x, search, port.searches, record, scratch)
        if mode < 0:
            return ZENO, base, mode, state
        search += port.searches
        base += 1
        to_tick -= 1
        to_record -= 1
    return DONE, base, mode, state
