"""Tables of the sampled loop's blocks: the map of one tick and the flow after it, and the rows of all that may switch.

The state is the plant's, followed by the law's, the voltages on their way and the reference with its derivatives. The
count of a sensor with a resolution is a state too: it is constant up to the tick that measures another one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control.law import LawParameters
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, subroutine
from servotwin.hybrid.flow import product
from servotwin.hybrid.lifted import LiftedTables, LiftedWorkspace, add_square, cubic_weights, fill_slot
from servotwin.hybrid.lifted_vast import deepen_slot
from servotwin.hybrid.tables import NODES_COARSE, NODES_FINE, TERMS, Tables

LINEAR, LIMITED, RATE_LIMITED = 0, 1, 2
KINDS = 3
"""Branches of the limits: neither acts, the voltage limit does, the rate limit does."""


class Places(NamedTuple):
    """Indices of the state; -1 where it does not exist."""

    plant: int  # states of the plant
    states: int  # all of them
    voltage: int  # applied
    position: int
    integral: int
    derivative: int
    filtered: int
    rate: int  # the rate limit's change per tick, with the sign of the present one
    feedforward: int
    past: int  # reference of the last tick
    ahead: int
    notch: int  # its band-pass
    notch_low: int
    counted: int  # position as last measured, of a sensor that counts
    waiting: int  # first of the voltages on their way, the next one to be applied
    delay: int  # how many
    reference: int  # and its derivatives
    degree: int


class LiftedLoop(NamedTuple):
    """One sampled loop: the law, thresholds in force, and the plant's search."""

    parameters: LawParameters
    dead_zone: bool
    searches: int
    step: float  # of the search, s
    flows: Array  # M * n * n, row-major
    modes: int
    resolution: float  # m, of the position sensor; 0.0: it is ideal


class LiftedMemory(NamedTuple):
    """Tables and working memory of one run."""

    lifted: LiftedTables
    workspace: LiftedWorkspace
    filled: NDArray[np.int8]  # (slots,): 1, or 2 with the vast scale
    vast: NDArray[np.int8]  # (slots,): 1 where the present run uses the vast scale
    voltage_rows: Array  # slots * N: the applied voltage after a tick, of the state before it
    low: Array
    high: Array
    slack: Array
    squares: Array
    out: Array
    change: Array
    sizes: Array
    tick_map: Array  # N * N: the tick alone, less I
    flow_map: Array  # n * n: the flow of one tick, less I


class Place(NamedTuple):
    """Progress of a run.

    ``at = [tick, mode, active, kind, side of the error, ticks since a switch or another count, need of the vast scale,
    1: same count as before, ticks that the last count stayed]``; `sign` of the limit that acts.
    """

    at: NDArray[np.int64]
    sign: Array


@inlined
def _clear(row: Array) -> None:
    for i in range(np.uint64(row.size)):
        row[i] = 0.0


@inlined
def _fill_notch(p: LawParameters, places: Places, demand: Array, m: Array) -> None:
    """Fill the notch's part of the tick's map, while `demand` is the PIDF's row, and make it the notch's."""
    n, band, low = places.states, places.notch, places.notch_low
    for i in range(n):
        m[low * n + i] += p.notch_rise * demand[i]
        m[band * n + i] += p.notch_turn * demand[i]
    m[low * n + low] -= p.notch_rise
    m[low * n + band] += p.notch_turn
    m[band * n + low] -= p.notch_turn
    m[band * n + band] -= p.notch_fall
    demand[band] -= p.notch_gain


@inlined
def _fill_error(p: LawParameters, places: Places, error: Array, m: Array) -> None:
    """Fill the error's row, and the loop filter's part of the tick's map."""
    n, measured = places.states, places.counted if places.counted >= 0 else places.position
    _clear(error)
    error[places.reference] = 1.0
    error[measured] -= p.loop_step
    if places.filtered >= 0:
        error[places.filtered] -= 1.0 - p.loop_step
        m[places.filtered * n + measured] = p.loop_step
        m[places.filtered * n + places.filtered] = -p.loop_step


@inlined
def _fill_demand(p: LawParameters, places: Places, acting: bool, error: Array, demand: Array, m: Array) -> None:
    """Fill the row of the voltage demanded, and the parts of the tick's map that belong to notch and feedforward."""
    n = places.states
    _clear(demand)
    if acting:
        for i in range(n):
            demand[i] = (p.Kp + p.derivative_gain) * error[i]
        demand[places.integral] += 1.0
        demand[places.derivative] -= p.derivative_gain
    if places.notch >= 0:
        _fill_notch(p, places, demand, m)
    if places.feedforward >= 0:
        demand[places.feedforward] += 1.0
    if places.ahead >= 0:
        past, ahead = places.past, places.ahead
        demand[places.reference] += p.velocity_gain
        demand[past] -= p.velocity_gain
        demand[ahead] += p.velocity_gain * (1.0 - p.velocity_step)
        m[ahead * n + places.reference] += 1.0
        m[ahead * n + past] -= 1.0
        m[ahead * n + ahead] -= p.velocity_step
        m[past * n + places.reference] += 1.0
        m[past * n + past] -= 1.0


@subroutine
def _fill_tick(loop: LiftedLoop, places: Places, active: bool, kind: int, memory: LiftedMemory) -> None:
    """Fill the tick's map; the rows of the error and of the voltage demanded remain in `change` and `sizes`."""
    p, n, m = loop.parameters, places.states, memory.tick_map
    acting = active or p.acting_inside > 0.5
    error, demand = memory.change, memory.sizes
    _clear(m)
    _fill_error(p, places, error, m)
    _fill_demand(p, places, acting, error, demand, m)
    last = places.waiting + places.delay - 1 if places.delay > 0 else places.voltage
    # The law's own voltage, in place of the last one.
    for i in range(n):
        m[last * n + i] = demand[i] if kind == LINEAR else 0.0
    if kind == LINEAR:
        m[last * n + last] -= 1.0
    elif kind == RATE_LIMITED:
        m[last * n + places.rate] += 1.0
    if active:
        for i in range(n):
            new = m[last * n + i] + (1.0 if i == last else 0.0)
            m[places.integral * n + i] += p.integral_step * error[i] + p.tracking_step * (new - demand[i])
    if acting:
        for i in range(n):
            m[places.derivative * n + i] += p.filter_step * error[i]
    m[places.derivative * n + places.derivative] -= p.filter_step
    if places.delay > 0:
        m[places.voltage * n + places.waiting] += 1.0
        m[places.voltage * n + places.voltage] -= 1.0
        for i in range(places.waiting, last):
            m[i * n + i + 1] += 1.0
            m[i * n + i] -= 1.0


@subroutine
def _law_watches(loop: LiftedLoop, places: Places, memory: LiftedMemory, first: int) -> int:
    """Fill the rows of the law's watches from watch `first` on; return the number of watches."""
    p, n, error, demand = loop.parameters, places.states, memory.change, memory.sizes
    last = places.waiting + places.delay - 1 if places.delay > 0 else places.voltage
    count = first
    values = memory.workspace.values
    if loop.dead_zone:
        for i in range(n):
            values[count * n + i] = error[i]
        count += 1
    if p.voltage_limit < np.inf:
        for i in range(n):
            values[count * n + i] = demand[i]
        count += 1
    if places.rate >= 0:
        for i in range(n):
            values[count * n + i] = demand[i]
        values[count * n + last] -= 1.0
        count += 1
        for i in range(n):
            values[count * n + i] = 1.0 if i == last else 0.0
        count += 1
    if places.counted >= 0:
        for i in range(n):
            values[count * n + i] = 0.0
        values[count * n + places.position], values[count * n + places.counted] = 1.0, -1.0
        count += 1
    return count


@subroutine
def _fill_flow(t: Tables, loop: LiftedLoop, mode: int, memory: LiftedMemory) -> None:
    """The flow of one tick, from the tables of search steps."""
    n, flow, left, w = t.states, t.flow_of[mode], loop.searches, memory.workspace
    n2 = n * n
    for i in range(n2):
        memory.flow_map[i] = 0.0
    while left > 0:
        if left >= NODES_FINE:
            steps = min(left // NODES_FINE, NODES_COARSE)
            table, base = t.jump_coarse, (flow * NODES_COARSE + steps - 1) * n2
            left -= steps * NODES_FINE
        else:
            table, base = t.jump_fine, (flow * NODES_FINE + left - 1) * n2
            left = 0
        for i in range(n):
            for j in range(n):
                w.product[i * n + j] = table[base + j * n + i]
        for i in range(n):
            row = memory.flow_map[i * n : (i + 1) * n]
            product(w.product, 0, n, n, row, w.row[:n])
            for j in range(n):
                row[j] += w.product[i * n + j] + w.row[j]


@subroutine
def _fill_map(loop: LiftedLoop, places: Places, memory: LiftedMemory) -> None:
    """The tick, then the flow: ``(I + F)(I + T) - I``."""
    n, plant, m = places.states, places.plant, memory.workspace.map
    for i in range(n * n):
        m[i] = memory.tick_map[i]
    for i in range(plant):
        for k in range(plant):
            factor = memory.flow_map[i * plant + k]
            if factor != 0.0:
                m[i * n + k] += factor
                for j in range(n):
                    m[i * n + j] += factor * memory.tick_map[k * n + j]
    period, power = loop.searches * loop.step, 1.0
    for k in range(1, places.degree + 1):
        power *= period / k
        for i in range(places.degree + 1 - k):
            m[(places.reference + i) * n + places.reference + i + k] += power


@inlined
def _after_tick(places: Places, memory: LiftedMemory, row: Array, scale: float, out: Array) -> None:
    """A row of the plant's states after the tick as one of the state before it."""
    n, v = places.states, places.voltage
    for j in range(n):
        out[j] = scale * row[j] if j < places.plant else 0.0
    factor = out[v]
    if factor != 0.0:
        for j in range(n):
            out[j] += factor * memory.tick_map[v * n + j]


@subroutine
def _plant_watch(t: Tables, loop: LiftedLoop, places: Places, mode: int, guard: int, memory: LiftedMemory) -> None:
    """Rows of a guard of the plant; `rows` begins with its value and slope over a search step, after the tick."""
    w, n, plant, searches = memory.workspace, places.states, places.plant, loop.searches
    at = (mode * t.guards + guard) * plant
    third = loop.step / 3.0
    # Of the plant's states after the tick: the value, and a third of its slope over a search step.
    value, slope = w.rows[:plant], w.rows[n : n + plant]
    for i in range(plant):
        value[i] = t.rows[at + i]
    product(loop.flows, mode * plant * plant, plant, plant, value, slope)
    for i in range(plant):
        slope[i] *= third
    to = guard * n
    _clear(w.values[to : to + n])
    _clear(w.ends[to : to + n])
    for i in range(plant):
        w.values[to + i], w.ends[to + i] = value[i], searches * slope[i]
    _after_tick(places, memory, slope, searches, w.starts[to : to + n])
    _clear(w.sizes[to : to + n])
    for i in range(plant):
        w.sizes[to + i] = t.sizes[(mode * t.guards + guard) * TERMS * plant + i]


@subroutine
def _tick_cubic(t: Tables, loop: LiftedLoop, places: Places, mode: int, memory: LiftedMemory) -> None:
    """Control points of a guard's cubic over a tick, and the flow over a search step, as a deviation."""
    w, n, plant, searches = memory.workspace, places.states, places.plant, loop.searches
    value, slope, points = w.rows[:plant], w.rows[n : n + plant], w.rows[4 * n : 8 * n]
    for i in range(plant):
        points[i], points[n + i] = value[i], value[i] + searches * slope[i]
    for i in range(plant):
        for j in range(plant):
            # The tables hold deviations transposed.
            w.product[i * plant + j] = t.jump_fine[(t.flow_of[mode] * NODES_FINE * plant + j) * plant + i]
    final, final_slope = w.rows[8 * n : 8 * n + plant], w.rows[9 * n : 9 * n + plant]
    product(memory.flow_map, 0, plant, plant, value, final)
    product(memory.flow_map, 0, plant, plant, slope, final_slope)
    for i in range(plant):
        last = value[i] + final[i]
        points[3 * n + i] = last
        points[2 * n + i] = last - searches * (slope[i] + final_slope[i])


@subroutine
def _inside_tick(t: Tables, loop: LiftedLoop, places: Places, mode: int, guard: int, memory: LiftedMemory) -> None:
    """Sum the squares of a guard's deviation from its cubic over a tick, at the control points of every search step."""
    w, n, plant, searches = memory.workspace, places.states, places.plant, loop.searches
    base = guard * n * n
    for i in range(n * n):
        w.inside[base + i] = 0.0
    if searches == 1:
        return
    _tick_cubic(t, loop, places, mode, memory)
    value, slope, points = w.rows[:plant], w.rows[n : n + plant], w.rows[4 * n : 8 * n]
    new_value, new_slope = w.rows[2 * n : 2 * n + plant], w.rows[3 * n : 3 * n + plant]
    deviation, whole = w.rows[10 * n : 10 * n + plant], w.rows[11 * n : 12 * n]
    for s in range(searches):
        product(w.product, 0, plant, plant, value, new_value)
        product(w.product, 0, plant, plant, slope, new_slope)
        for i in range(plant):
            new_value[i] += value[i]
            new_slope[i] += slope[i]
        for point in range(1, 4):
            u = (s if point == 1 else s + 1) / searches
            tilt = 0.0 if point == 3 else (1.0 if point == 1 else -1.0) / searches
            c0, c1, c2, c3 = cubic_weights(u, tilt)
            for i in range(plant):
                true = value[i] + slope[i] if point == 1 else new_value[i] - (new_slope[i] if point == 2 else 0.0)
                cubic = (c0 * points[i] + c1 * points[n + i]) + (c2 * points[2 * n + i] + c3 * points[3 * n + i])
                deviation[i] = true - cubic
            _after_tick(places, memory, deviation, 1.0, whole)
            add_square(n, whole, w.inside, base, n)
        for i in range(plant):
            value[i], slope[i] = new_value[i], new_slope[i]


@inlined
def slot_of(mode: int, active: bool, kind: int) -> int:
    """Slot of a mode of the plant and a branch of the law."""
    return (mode * 2 + (1 if active else 0)) * KINDS + kind


@bare
def fill_here(t: Tables, loop: LiftedLoop, places: Places, place: Place, memory: LiftedMemory) -> None:
    """Fill the slot of the plant's mode and the law's branch where a run is; the vast scale where it is needed."""
    mode, active, kind = place.at[1], place.at[2] == 1, place.at[3]
    n, w, slot = places.states, memory.workspace, slot_of(mode, active, kind)
    guards, new = t.guard_count[mode], memory.filled[slot] == 0
    _fill_tick(loop, places, active, kind, memory)
    watches = _law_watches(loop, places, memory, guards)
    _fill_flow(t, loop, mode, memory)
    _fill_map(loop, places, memory)
    for guard in range(guards):
        _plant_watch(t, loop, places, mode, guard, memory)
        if new:
            _inside_tick(t, loop, places, mode, guard, memory)
        w.discrete[guard] = 0.0
    for watch in range(guards, watches):
        w.discrete[watch] = 1.0
        row, rise = w.values[watch * n : (watch + 1) * n], w.starts[watch * n : (watch + 1) * n]
        product(w.map, 0, n, n, row, rise)
        for i in range(n):
            rise[i] /= 3.0
            w.ends[watch * n + i], w.sizes[watch * n + i] = rise[i], abs(row[i])
        for i in range(n * n):
            w.inside[watch * n * n + i] = 0.0
    for i in range(n):
        memory.voltage_rows[slot * n + i] = memory.tick_map[places.voltage * n + i] + (i == places.voltage)
    if new:
        fill_slot(memory.lifted, slot, watches, w)
        memory.filled[slot] = 1
    if place.at[6] == 1:
        deepen_slot(memory.lifted, slot, watches, w)
        memory.filled[slot] = 2
