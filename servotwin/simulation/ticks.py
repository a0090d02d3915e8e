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
from servotwin.hybrid.tables import Tables

tick = verbatim(law.tick)


class Port(NamedTuple):
    """Indices of the plant states that the sampled loop reads and writes, and the division of its steps."""

    voltage: int
    position: int
    motor: int
    resolution: float
    counted: int  # 1: the sensor counts, 0: it is ideal
    recorded: NDArray[np.int64]  # states written at every recorded step
    tick_every: int
    record_every: int
    searches: int  # search steps per base step
    room: int  # events after which the record counts as full
    delayed: Array  # (d,) voltages that are computed but not yet applied, tick i's at i % d; empty: no delay
    late: Array  # (d,) readings of the position sensor that are not shown yet, likewise


class TickInputs(NamedTuple):
    """Inputs of the ticks from tick `first` on; one value stands for all of them where a mask is 0 and not -1."""

    first: int
    reference: Array
    noise: Array
    enter: Array
    leave: Array
    motor: Array  # rad, errors of the motor's encoder
    reference_mask: int
    noise_mask: int
    zone_mask: int
    motor_mask: int


class Output(NamedTuple):
    """Buffers of what is recorded, from a sample and a tick on."""

    states: Array  # (recorded, samples)
    measured: Array  # (ticks,)
    active: NDArray[np.int8]  # (ticks,)
    motor: Array  # (ticks,) the motor's true angle, or empty
    first_sample: int
    first_tick: int


def new_output(rows: int, samples: int, tick_every: int, record_every: int, motor: bool) -> Output:
    """Buffers for so many samples of `rows` states, and for their ticks, with the motor's angle at these or without."""
    ticks = -(-((samples - 1) * record_every + 1) // tick_every)
    angles = np.empty(ticks if motor else 0)
    return Output(np.empty((rows, samples)), np.empty(ticks), np.empty(ticks, dtype=np.int8), angles, 0, 0)


def shifted_output(output: Output, sample: int, tick_every: int, record_every: int) -> Output:
    """Shift the buffers to begin at `sample`; older samples are dropped."""
    tick = sample * record_every // tick_every
    for values, by in (
        (output.states, sample - output.first_sample),
        (output.measured, tick - output.first_tick),
        (output.active, tick - output.first_tick),
        (output.motor, tick - output.first_tick),
    ):
        # Source and destination overlap: the copy is needed.
        values[..., : values.shape[-1] - by] = values[..., by:].copy()
    return output._replace(first_sample=sample, first_tick=tick)


@inlined
def measured(position: float, noise: float, port: Port) -> float:
    """The measurement: noise, then whole counts."""
    y = position + noise
    # A loop, for a branch would be compiled as a choice, and the tick would wait for a division without need.
    for _ in range(port.counted):
        y = np.round(y / port.resolution) * port.resolution
    return y


@inlined
def in_turn(i: int, value: float, waiting: Array) -> float:
    """The value of `waiting.size` ticks ago; that of tick i waits in its place."""
    if waiting.size == 0:
        return value
    place = i % waiting.size
    earlier = waiting[place]
    waiting[place] = value
    return earlier


@inlined
def tick_between(
    parameters: LawParameters, enter: float, leave: float, state: LawState, reference: float, y: float
) -> LawState:
    """The edge's tick with its thresholds of the instant."""
    now = LawParameters(
        parameters.Kp,
        parameters.integral_step,
        parameters.derivative_gain,
        parameters.filter_step,
        enter,
        leave,
        parameters.voltage_limit,
        parameters.rate_step,
        parameters.loop_step,
        parameters.tracking_step,
        parameters.feedforward,
        parameters.release_step,
        parameters.acting_inside,
        parameters.velocity_gain,
        parameters.velocity_step,
        parameters.friction,
        parameters.notch_gain,
        parameters.notch_fall,
        parameters.notch_rise,
        parameters.notch_turn,
    )
    return tick(now, state, reference, y)


@inlined
def take_tick(
    i: int,
    position: float,
    parameters: LawParameters,
    state: LawState,
    port: Port,
    tick_inputs: TickInputs,
    output: Output,
) -> LawState:
    """Measure, tick, record both."""
    k, at = i - tick_inputs.first, np.uint64(i - output.first_tick)
    zone = np.uint64(k & tick_inputs.zone_mask)
    y = measured(position, tick_inputs.noise[np.uint64(k & tick_inputs.noise_mask)], port)
    y = in_turn(i, y, port.late)
    reference = tick_inputs.reference[np.uint64(k & tick_inputs.reference_mask)]
    state = tick_between(parameters, tick_inputs.enter[zone], tick_inputs.leave[zone], state, reference, y)
    output.measured[at] = y
    output.active[at] = 1 if state.active > 0.5 else 0
    return state


@inlined
def note_motor(i: int, x: Array, port: Port, output: Output) -> None:
    """Record the motor's true angle at tick i, where that is asked for."""
    if output.motor.size > 0:
        output.motor[i - output.first_tick] = x[port.motor]


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
        i, position = base // port.tick_every, x[port.position]
        note_motor(i, x, port, output)
        state = take_tick(i, position, parameters, state, port, tick_inputs, output)
        x[port.voltage] = in_turn(i, state.voltage, port.delayed)
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
            note_motor(i, x, port, output)
            state = take_tick(i, x[port.position], parameters, state, port, tick_inputs, output)
            x[port.voltage] = in_turn(i, state.voltage, port.delayed)
            to_tick = port.tick_every
            i += 1
        if to_record == 0:
            write_sample(row, x, port, output)
            to_record = port.record_every
            row += 1
        for _ in range(port.searches):
            mode = step_once(t, mode, x, search, record, scratch)
            search += 1
            record.size[0] = 0
            if mode < 0:
                return ZENO, base, mode, state
        base += 1
        to_tick -= 1
        to_record -= 1
    return DONE, base, mode, state
