"""The compiled half of the sampled loop of a linear law: measure motor and load, tick, record, flow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.control import linear_tick
from servotwin.control.linear_tick import LinearParameters, LinearState
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, verbatim
from servotwin.hybrid.flow import Scratch
from servotwin.hybrid.kernel import DONE, FULL, ZENO, RunRecord, step_once
from servotwin.hybrid.tables import Tables
from servotwin.simulation.ticks import Output, Port, TickInputs, in_turn, measured, note_motor, write_sample

tick = verbatim(linear_tick.linear_tick)


class TwoSensors(NamedTuple):
    """Port of a law that reads motor and load."""

    port: Port
    resolution: float  # rad per count of its encoder
    counted: int  # 1: it counts, 0: it is ideal
    late: Array  # (d,) readings of it that are not shown yet, tick i's at i % d


@inlined
def motor_angle(angle: float, sensors: TwoSensors) -> float:
    """The motor's measured angle: whole counts."""
    y = angle
    for _ in range(sensors.counted):
        y = np.round(y / sensors.resolution) * sensors.resolution
    return y


@inlined
def take_law_tick(
    i: int,
    x: Array,
    parameters: LinearParameters,
    state: LinearState,
    sensors: TwoSensors,
    tick_inputs: TickInputs,
    output: Output,
) -> LinearState:
    """Measure, tick, record both; the recorded measurement is the load's."""
    note_motor(i, x, sensors.port, output)
    k, at = i - tick_inputs.first, np.uint64(i - output.first_tick)
    zone = np.uint64(k & tick_inputs.zone_mask)
    noise = tick_inputs.noise[np.uint64(k & tick_inputs.noise_mask)]
    y_load = in_turn(i, measured(x[sensors.port.position], noise, sensors.port), sensors.port.late)
    error = tick_inputs.motor[np.uint64(k & tick_inputs.motor_mask)]
    y_motor = in_turn(i, motor_angle(x[sensors.port.motor] + error, sensors), sensors.late)
    now = LinearParameters(
        parameters.advance,
        parameters.output,
        parameters.motor,
        parameters.load,
        tick_inputs.enter[zone],
        tick_inputs.leave[zone],
        parameters.limit,
        parameters.rate_step,
        parameters.feedforward,
        parameters.release_step,
    )
    state = tick(now, state, tick_inputs.reference[np.uint64(k & tick_inputs.reference_mask)], y_motor, y_load)
    output.measured[at] = y_load
    output.active[at] = 1 if state.active > 0.5 else 0
    return state


@bare
def law_tick_and_record(
    base: int,
    x: Array,
    parameters: LinearParameters,
    state: LinearState,
    sensors: TwoSensors,
    tick_inputs: TickInputs,
    output: Output,
) -> LinearState:
    """Tick and record where they are due at a base step, before the plant flows on."""
    port = sensors.port
    if base % port.tick_every == 0:
        i = base // port.tick_every
        state = take_law_tick(i, x, parameters, state, sensors, tick_inputs, output)
        x[port.voltage] = in_turn(i, state.command, port.delayed)
    if base % port.record_every == 0:
        write_sample(base // port.record_every, x, port, output)
    return state


@bare
def run_law_ticks(
    t: Tables,
    x: Array,
    base: int,
    end: int,
    mode: int,
    parameters: LinearParameters,
    state: LinearState,
    sensors: TwoSensors,
    tick_inputs: TickInputs,
    output: Output,
    record: RunRecord,
    scratch: Scratch,
) -> tuple[int, int, int, LinearState]:
    """Run base steps `base` .. `end` - 1; return status, the next base step, mode and law state. Stops early when
    `record` is full."""
    port = sensors.port
    search = base * port.searches
    while base < end:
        if record.size[1] > port.room:
            return FULL, base, mode, state
        if base % port.tick_every == 0:
            i = base // port.tick_every
            state = take_law_tick(i, x, parameters, state, sensors, tick_inputs, output)
            x[port.voltage] = in_turn(i, state.command, port.delayed)
        if base % port.record_every == 0:
            write_sample(base // port.record_every, x, port, output)
        for _ in range(port.searches):
            mode = step_once(t, mode, x, search, record, scratch)
            search += 1
            record.size[0] = 0
            if mode < 0:
                return ZENO, base, mode, state
        base += 1
    return DONE, base, mode, state
