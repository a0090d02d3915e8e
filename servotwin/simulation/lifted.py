"""The compiled half of the sampled loop without noise: blocks of ticks where nothing switches, the tick where it does.

The state is the plant's, followed by the law's, the voltages on their way and the reference with its derivatives. Where
the plant's mode and the law's branches stay the same, a tick and the flow after it are one linear map.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control import law
from servotwin.control.law import LawParameters, LawState
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, verbatim
from servotwin.hybrid.flow import Scratch, dot, product
from servotwin.hybrid.kernel import DONE, EVENTS_PER_STEP, FULL, ZENO, RunRecord, step_once
from servotwin.hybrid.lifted import (
    BLOCK,
    COARSE,
    FINE,
    LiftedTables,
    LiftedWorkspace,
    advance_ticks,
    fill_slot,
)
from servotwin.hybrid.tables import NODES_COARSE, NODES_FINE, TERMS, Tables

tick = verbatim(law.tick)

LINEAR, LIMITED, RATE_LIMITED = 0, 1, 2
KINDS = 3
UNFILLED = 3
"""Status of a run that needs the tables of the mode and branch where it is."""
"""Branches of the limits: neither acts, the voltage limit does, the rate limit does."""
TICKED = -1
"""Slot of a segment that is one tick, its state taken after it."""


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
    waiting: int  # first of the voltages on their way, the next one to be applied
    delay: int  # how many
    reference: int  # and its derivatives
    degree: int


class Loop(NamedTuple):
    """One sampled loop: the law, thresholds in force, and the plant's search."""

    parameters: LawParameters
    dead_zone: bool
    searches: int
    step: float  # of the search, s
    flows: Array  # M * n * n, row-major
    modes: int


class Segments(NamedTuple):
    """Growing record: starts of blocks and single ticks; ``size[0]`` are filled, and `size[1]` changes of the dead
    zone."""

    size: NDArray[np.int64]
    tick: NDArray[np.int64]
    slot: NDArray[np.int64]
    state: Array
    change_tick: NDArray[np.int64]
    change_active: NDArray[np.bool_]
    change_error: Array


class LiftedMemory(NamedTuple):
    """Tables and working memory of one run."""

    lifted: LiftedTables
    workspace: LiftedWorkspace
    filled: NDArray[np.int8]  # (slots,)
    voltage_rows: Array  # slots * N: the applied voltage after a tick, of the state before it
    low: Array
    high: Array
    slack: Array
    out: Array
    change: Array
    sizes: Array
    tick_map: Array  # N * N: the tick alone, less I
    flow_map: Array  # n * n: the flow of one tick, less I


class Place(NamedTuple):
    """Where a run is: ``at = [tick, mode, active, kind, side of the error, ticks since a switch]``; `sign` of the limit
    that acts."""

    at: NDArray[np.int64]
    sign: Array


def new_segments(states: int, room: int) -> Segments:
    """An empty record."""
    return Segments(
        np.zeros(2, dtype=np.int64),
        np.empty(room, dtype=np.int64),
        np.empty(room, dtype=np.int64),
        np.empty((room, states)),
        np.empty(room, dtype=np.int64),
        np.empty(room, dtype=bool),
        np.empty(room),
    )


def more_segments(segments: Segments) -> Segments:
    """A copy with twice the room."""
    larger = new_segments(segments.state.shape[1], 2 * len(segments.tick))
    for old, new in zip(segments, larger, strict=True):
        new[: len(old)] = old
    return larger


@inlined
def set_reference(places: Places, coefficients: Array, elapsed: float, z: Array) -> None:
    """Value and derivatives of the reference's cubic after a time in it."""
    c0, c1, c2, c3 = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    at = places.reference
    z[at] = ((c3 * elapsed + c2) * elapsed + c1) * elapsed + c0
    if places.degree > 0:
        z[at + 1] = (3.0 * c3 * elapsed + 2.0 * c2) * elapsed + c1
    if places.degree > 1:
        z[at + 2] = 6.0 * c3 * elapsed + 2.0 * c2
    if places.degree > 2:
        z[at + 3] = 6.0 * c3


@bare
def take_tick(loop: Loop, places: Places, z: Array, place: Place) -> float:
    """The edge's tick on the state; return the error that was measured."""
    p, y = loop.parameters, z[places.position]
    last = z[places.waiting + places.delay - 1] if places.delay > 0 else z[places.voltage]
    filtered = z[places.filtered] if places.filtered >= 0 else y
    active = 1.0 if place.at[2] == 1 else 0.0
    state = LawState(z[places.integral], z[places.derivative], filtered, last, active, 0.0)
    new = tick(p, state, z[places.reference], y)
    z[places.integral], z[places.derivative] = new.integral, new.derivative
    if places.filtered >= 0:
        z[places.filtered] = new.filtered
    if places.delay > 0:
        z[places.voltage] = z[places.waiting]
        for i in range(places.waiting, places.waiting + places.delay - 1):
            z[i] = z[i + 1]
        z[places.waiting + places.delay - 1] = new.voltage
    else:
        z[places.voltage] = new.voltage
    error = z[places.reference] - new.filtered
    place.at[2] = 1 if new.active > 0.5 else 0
    # The side of the error counts only where the loop is about to open.
    place.at[4] = (1 if error > 0.0 else -1) if loop.dead_zone and place.at[2] == 1 else 0
    place.at[3], place.sign[0] = LINEAR, 0.0
    if places.rate >= 0 and (new.voltage == last + p.rate_step or new.voltage == last - p.rate_step):
        place.at[3], place.sign[0] = RATE_LIMITED, (1.0 if new.voltage > last else -1.0)
        z[places.rate] = place.sign[0] * p.rate_step
    elif new.voltage == p.voltage_limit or new.voltage == -p.voltage_limit:
        place.at[3], place.sign[0] = LIMITED, (1.0 if new.voltage > 0.0 else -1.0)
    return z[places.reference] - y


@inlined
def _clear(row: Array) -> None:
    for i in range(np.uint64(row.size)):
        row[i] = 0.0


@bare
def _law_rows(loop: Loop, places: Places, active: bool, kind: int, memory: LiftedMemory, first: int) -> int:
    """Fill the tick's map and the law's watches from watch `first` on; return the number of watches."""
    p, n, m = loop.parameters, places.states, memory.tick_map
    error, wanted = memory.change, memory.sizes
    _clear(error)
    _clear(wanted)
    _clear(m)
    error[places.reference] = 1.0
    error[places.position] -= p.loop_step
    if places.filtered >= 0:
        error[places.filtered] -= 1.0 - p.loop_step
        m[places.filtered * n + places.position] = p.loop_step
        m[places.filtered * n + places.filtered] = -p.loop_step
    if active:
        for i in range(n):
            wanted[i] = (p.Kp + p.derivative_gain) * error[i]
        wanted[places.integral] += 1.0
        wanted[places.derivative] -= p.derivative_gain
    if places.feedforward >= 0:
        wanted[places.feedforward] += 1.0
    last = places.waiting + places.delay - 1 if places.delay > 0 else places.voltage
    # The law's own voltage, in place of the last one.
    for i in range(n):
        m[last * n + i] = wanted[i] if kind == LINEAR else 0.0
    if kind == LINEAR:
        m[last * n + last] -= 1.0
    elif kind == RATE_LIMITED:
        m[last * n + places.rate] += 1.0
    if active:
        for i in range(n):
            new = m[last * n + i] + (1.0 if i == last else 0.0)
            m[places.integral * n + i] += p.integral_step * error[i] + p.tracking_step * (new - wanted[i])
            m[places.derivative * n + i] += p.filter_step * error[i]
    m[places.derivative * n + places.derivative] -= p.filter_step
    if places.delay > 0:
        m[places.voltage * n + places.waiting] += 1.0
        m[places.voltage * n + places.voltage] -= 1.0
        for i in range(places.waiting, last):
            m[i * n + i + 1] += 1.0
            m[i * n + i] -= 1.0
    count = first
    values = memory.workspace.values
    if loop.dead_zone:
        for i in range(n):
            values[count * n + i] = error[i]
        count += 1
    if p.voltage_limit < np.inf:
        for i in range(n):
            values[count * n + i] = wanted[i]
        count += 1
    if places.rate >= 0:
        for i in range(n):
            values[count * n + i] = wanted[i]
        values[count * n + last] -= 1.0
        count += 1
        for i in range(n):
            values[count * n + i] = 1.0 if i == last else 0.0
        count += 1
    return count


@bare
def _fill_flow(t: Tables, loop: Loop, mode: int, memory: LiftedMemory) -> None:
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


@bare
def _fill_map(loop: Loop, places: Places, memory: LiftedMemory) -> None:
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


@bare
def _plant_watch(t: Tables, loop: Loop, places: Places, mode: int, guard: int, memory: LiftedMemory) -> None:
    """Rows of a guard of the plant, and the squares of its deviation from a cubic within a tick."""
    w, n, plant, searches = memory.workspace, places.states, places.plant, loop.searches
    at = (mode * t.guards + guard) * plant
    third = loop.step / 3.0
    # Rows of the plant's states after the tick: value and a third of the slope, over a search step, at its steps.
    value, slope = w.rows[:plant], w.rows[n : n + plant]
    new_value, new_slope = w.rows[2 * n : 2 * n + plant], w.rows[3 * n : 3 * n + plant]
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
    base = guard * n * n
    for i in range(n * n):
        w.inside[base + i] = 0.0
    if searches == 1:
        return
    # The cubic over the tick: its control points.
    points = w.rows[4 * n : 8 * n]
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
    deviation, whole = w.rows[10 * n : 10 * n + plant], w.rows[11 * n : 12 * n]
    for s in range(searches):
        product(w.product, 0, plant, plant, value, new_value)
        product(w.product, 0, plant, plant, slope, new_slope)
        for i in range(plant):
            new_value[i] += value[i]
            new_slope[i] += slope[i]
        for point in range(1, 4):
            u = (s if point == 1 else s + 1) / searches
            v = 1.0 - u
            tilt = 0.0 if point == 3 else (1.0 if point == 1 else -1.0) / searches
            c0 = v * v * v - tilt * v * v
            c1 = 3.0 * v * v * u + tilt * (v * v - 2.0 * u * v)
            c2 = 3.0 * v * u * u + tilt * (2.0 * u * v - u * u)
            c3 = u * u * u + tilt * u * u
            for i in range(plant):
                true = value[i] + slope[i] if point == 1 else new_value[i] - (new_slope[i] if point == 2 else 0.0)
                cubic = (c0 * points[i] + c1 * points[n + i]) + (c2 * points[2 * n + i] + c3 * points[3 * n + i])
                deviation[i] = true - cubic
            _after_tick(places, memory, deviation, 1.0, whole)
            for i in range(n):
                if whole[i] != 0.0:
                    for j in range(n):
                        w.inside[base + i * n + j] += whole[i] * whole[j]
        for i in range(plant):
            value[i], slope[i] = new_value[i], new_slope[i]


@inlined
def slot_of(mode: int, active: bool, kind: int) -> int:
    """Slot of a mode of the plant and a branch of the law."""
    return (mode * 2 + (1 if active else 0)) * KINDS + kind


@bare
def fill_here(t: Tables, loop: Loop, places: Places, place: Place, memory: LiftedMemory) -> None:
    """Fill the slot of the plant's mode and the law's branch where a run is."""
    mode, active, kind = place.at[1], place.at[2] == 1, place.at[3]
    n, w, slot = places.states, memory.workspace, slot_of(mode, active, kind)
    guards = t.guard_count[mode]
    watches = _law_rows(loop, places, active, kind, memory, guards)
    _fill_flow(t, loop, mode, memory)
    _fill_map(loop, places, memory)
    for guard in range(guards):
        _plant_watch(t, loop, places, mode, guard, memory)
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
    fill_slot(memory.lifted, slot, watches, w)
    memory.filled[slot] = 1


@inlined
def set_bounds(t: Tables, loop: Loop, places: Places, place: Place, memory: LiftedMemory) -> int:
    """Bounds of the watches where the run is; return their number."""
    p, low, high, slack = loop.parameters, memory.low, memory.high, memory.slack
    count, kind, sign = t.guard_count[place.at[1]], place.at[3], place.sign[0]
    for g in range(count):
        low[g], high[g], slack[g] = -np.inf, 0.0, 1.0
    if loop.dead_zone:
        if place.at[2] == 0:
            low[count], high[count] = -p.leave, p.leave
        elif place.at[4] > 0:
            low[count], high[count] = p.enter, np.inf
        else:
            low[count], high[count] = -np.inf, -p.enter
        slack[count] = -1.0
        count += 1
    if p.voltage_limit < np.inf:
        low[count], high[count], slack[count] = -p.voltage_limit, p.voltage_limit, -1.0
        if kind == LIMITED:
            low[count] = p.voltage_limit if sign > 0.0 else -np.inf
            high[count] = np.inf if sign > 0.0 else -p.voltage_limit
        elif kind == RATE_LIMITED:
            low[count], high[count] = -np.inf, np.inf
        count += 1
    if places.rate >= 0:
        step, room = p.rate_step, p.voltage_limit - p.rate_step
        low[count], high[count], slack[count] = -step, step, -1.0
        low[count + 1], high[count + 1], slack[count + 1] = -np.inf, np.inf, -1.0
        if kind == RATE_LIMITED:
            low[count], high[count] = (step, np.inf) if sign > 0.0 else (-np.inf, -step)
            low[count + 1] = -np.inf if sign > 0.0 else -room
            high[count + 1] = room if sign > 0.0 else np.inf
        elif kind == LIMITED:
            low[count], high[count] = -np.inf, np.inf
        count += 2
    return count


@inlined
def note(segments: Segments, k: int, slot: int, z: Array) -> None:
    """Record the start of a block, of a rest, or a tick."""
    at = segments.size[0]
    segments.tick[at], segments.slot[at] = k, slot
    for i in range(np.uint64(z.size)):
        segments.state[at, i] = z[i]
    segments.size[0] = at + 1


@bare
def advance_block(
    t: Tables, loop: Loop, places: Places, z: Array, place: Place, end: int, segments: Segments, memory: LiftedMemory
) -> int:
    """Advance by blocks while nothing switches, to tick `end` at most; return the ticks advanced."""
    slot, begin, lifted = slot_of(place.at[1], place.at[2] == 1, place.at[3]), place.at[0], memory.lifted
    watches, k = set_bounds(t, loop, places, place, memory), place.at[0]
    while end - k >= 2 and segments.size[0] + 4 < len(segments.tick):
        if place.at[5] >= FINE and end - k >= FINE:
            wanted = min(COARSE, (end - k) // FINE)
            note(segments, k, slot, z)
            clean = advance_ticks(
                lifted, slot, watches, COARSE, wanted, memory.low, memory.high, memory.slack, z, memory.out,
                memory.change,
            )  # fmt: skip
            k += clean * FINE
            place.at[5] += clean * FINE
            if clean == wanted:
                continue
            if clean == 0:
                segments.size[0] -= 1
        wanted = min(FINE, end - k)
        note(segments, k, slot, z)
        clean = advance_ticks(
            lifted, slot, watches, FINE, wanted, memory.low, memory.high, memory.slack, z, memory.out, memory.change
        )
        k += clean
        place.at[5] += clean
        if clean == 0:
            segments.size[0] -= 1
        if clean < wanted:
            break
    place.at[0] = k
    return k - begin


@bare
def run_lifted(
    t: Tables,
    loop: Loop,
    places: Places,
    coefficients: Array,
    origin: float,
    rate: float,
    z: Array,
    place: Place,
    end: int,
    segments: Segments,
    record: RunRecord,
    scratch: Scratch,
    memory: LiftedMemory,
) -> int:
    """Run ticks up to `end` under one cubic of the reference, that begins at `origin` (s); `rate` in ticks/s. Returns
    FULL where a record must grow, and UNFILLED where `fill_here` is due."""
    at, x = place.at, z[: places.plant]
    room = len(record.event_step) - 2 * EVENTS_PER_STEP
    while at[0] < end:
        if segments.size[0] + 8 > len(segments.tick) or segments.size[1] + 8 > len(segments.tick):
            return FULL
        if record.size[1] > room:
            return FULL
        set_reference(places, coefficients, at[0] / rate - origin, z)
        if at[5] > 0 and end - at[0] >= 2:
            if memory.filled[slot_of(at[1], at[2] == 1, at[3])] == 0:
                return UNFILLED
            if advance_block(t, loop, places, z, place, end, segments, memory) > 0:
                if at[0] >= end:
                    break
                set_reference(places, coefficients, at[0] / rate - origin, z)
        active, mode, side, kind, sign = at[2], at[1], at[4], at[3], place.sign[0]
        error = take_tick(loop, places, z, place)
        # The first tick finds the zone that holds at the start.
        if at[2] != active and at[0] > 0:
            change = segments.size[1]
            segments.change_tick[change], segments.change_active[change] = at[0], at[2] == 1
            segments.change_error[change] = error
            segments.size[1] = change + 1
        note(segments, at[0], TICKED, z)
        step = at[0] * loop.searches
        for _ in range(loop.searches):
            at[1] = step_once(t, at[1], x, step, record, scratch)
            step += 1
            record.size[0] = 0
            if at[1] < 0:
                return ZENO
        # Another branch may hold for one tick only: blocks begin after two alike.
        alike = at[1] == mode and at[2] == active and at[4] == side and at[3] == kind and place.sign[0] == sign
        at[5] = at[5] + 1 if alike else 0
        at[0] += 1
    return DONE


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
