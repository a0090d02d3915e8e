"""The compiled sampled loop without noise: blocks of ticks where nothing switches, the tick where something may."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control import law
from servotwin.control.law import LawParameters, LawState
from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined, subroutine, verbatim
from servotwin.hybrid.flow import LINGERING, Scratch
from servotwin.hybrid.kernel import DONE, EVENTS_PER_STEP, FULL, ZENO, RunRecord, step_once
from servotwin.hybrid.lifted import BLOCK, COARSE, FINE
from servotwin.hybrid.lifted_blocks import clean_ticks, jump
from servotwin.hybrid.tables import Tables
from servotwin.simulation.lifted_tables import (
    LIMITED,
    LINEAR,
    RATE_LIMITED,
    LiftedLoop,
    LiftedMemory,
    Place,
    Places,
    slot_of,
)

tick = verbatim(law.tick)

UNFILLED = 3
"""Status of a run that needs the tables of the mode and branch where it is."""
# The vast scale's tables pay after so many calm ticks, and where so many more are to come. A run uses them from there
# on, also where another run has filled them: they round otherwise, and no run may depend on the others.
_PAYS, _WORTH, _CALM = 32 * BLOCK, 16 * COARSE * BLOCK, FINE
# Longest time in ticks until a block is tried again of which again and again not even the first interval was clean.
_LONGEST = 8 * FINE
# Ticks that a count must last before a block pays: the next ones are likely to last as long, this one as long again.
_LASTS = 16
TICKED = -1
"""Slot of a segment that is one tick, its state taken after it."""
VAST = -2
"""``VAST - slot`` is that of a segment of up to 16 blocks."""


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


@inlined
def latest_direction(moved: float, before: float) -> float:
    """Sign of the last change of the reference, after a move (m), which may be none."""
    direction = before
    if moved > 0.0:
        direction = 1.0
    elif moved < 0.0:
        direction = -1.0
    return direction


@inlined
def with_feedforward_of(parameters: LawParameters, places: Places, z: Array) -> LawParameters:
    """The law's parameters with all that is always added as one feedforward, which is a state."""
    p = parameters
    fed = z[places.feedforward] if places.feedforward >= 0 else 0.0
    return LawParameters(
        p.Kp, p.integral_step, p.derivative_gain, p.filter_step, p.enter, p.leave, p.voltage_limit, p.rate_step,
        p.loop_step, p.tracking_step, fed, p.release_step, p.acting_inside, p.velocity_gain, p.velocity_step, 0.0,
        p.notch_gain, p.notch_fall, p.notch_rise, p.notch_turn,
    )  # fmt: skip


@bare
def take_tick(loop: LiftedLoop, places: Places, z: Array, place: Place) -> float:
    """The edge's tick on the state; return the error that was measured."""
    p, y = with_feedforward_of(loop.parameters, places, z), z[places.position]
    if places.counted >= 0:
        y = np.round(y / loop.resolution) * loop.resolution
        place.at[7] = 1 if y == z[places.counted] else 0
        z[places.counted] = y
    last = z[places.waiting + places.delay - 1] if places.delay > 0 else z[places.voltage]
    filtered = z[places.filtered] if places.filtered >= 0 else y
    active = 1.0 if place.at[2] == 1 else 0.0
    past, ahead = (z[places.past], z[places.ahead]) if places.ahead >= 0 else (z[places.reference], 0.0)
    band, low = (z[places.notch], z[places.notch_low]) if places.notch >= 0 else (0.0, 0.0)
    state = LawState(z[places.integral], z[places.derivative], filtered, last, active, 0.0, past, ahead, 0.0, band, low)
    new = tick(p, state, z[places.reference], y)
    z[places.integral], z[places.derivative] = new.integral, new.derivative
    if places.filtered >= 0:
        z[places.filtered] = new.filtered
    if places.ahead >= 0:
        z[places.past], z[places.ahead] = new.reference, new.ahead
    if places.notch >= 0:
        z[places.notch], z[places.notch_low] = new.notch_band, new.notch_low
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
def set_bounds(t: Tables, loop: LiftedLoop, places: Places, place: Place, memory: LiftedMemory) -> int:
    """Bounds of the watches where the run is; return their number."""
    p, low, high, slack = loop.parameters, memory.low, memory.high, memory.slack
    count, kind, sign = t.guard_count[place.at[1]], place.at[3], place.sign[0]
    for g in range(count):
        low[g], high[g], slack[g] = -np.inf, 0.0, LINGERING
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
    if places.counted >= 0:
        low[count], high[count], slack[count] = -0.5 * loop.resolution, 0.5 * loop.resolution, -1.0
        count += 1
    return count


@inlined
def note(segments: Segments, k: int, slot: int, z: Array) -> None:
    """Record the start of a block, of a rest, or a tick."""
    at = segments.size[0]
    segments.tick[at], segments.slot[at] = k, slot
    for i in range(np.uint64(z.size)):
        segments.state[at, i] = z[i]
    segments.size[0] = at + 1


@inlined
def deepens(place: Place, end: int, vast: int) -> bool:
    """True where a run has been calm, and goes on so long that the tables of the vast scale pay."""
    return vast == 0 and place.at[5] >= _PAYS and end - place.at[0] >= _WORTH


@inlined
def vast_blocks(
    z: Array, place: Place, slot: int, watches: int, end: int, segments: Segments, memory: LiftedMemory
) -> bool:
    """Advance by intervals of 128 ticks, one start recorded for all; return True where a whole block was clean."""
    lifted = memory.lifted
    limit = min(COARSE, (end - place.at[0]) // BLOCK)
    clean = clean_ticks(
        lifted, lifted.vast, lifted.vast_sizes, slot, watches, COARSE, limit, memory.low, memory.high, memory.slack,
        True, memory.squares, memory.change, z, memory.out,
    )  # fmt: skip
    if clean > 0:
        note(segments, place.at[0], VAST - slot, z)
        jump(lifted.states, lifted.jump_vast, slot, COARSE, clean, z, memory.change)
        place.at[0], place.at[5] = place.at[0] + clean * BLOCK, place.at[5] + clean * BLOCK
    return clean == limit


@subroutine
def advance_block(z: Array, place: Place, watches: int, end: int, segments: Segments, memory: LiftedMemory) -> int:
    """Advance by blocks while nothing switches, to tick `end` at most; return the ticks advanced. Stops where
    `deepens`."""
    slot, begin, lifted = slot_of(place.at[1], place.at[2] == 1, place.at[3]), place.at[0], memory.lifted
    n, again, later, wait = lifted.states, begin, begin, 0
    low, high, slack, out = memory.low, memory.high, memory.slack, memory.out
    squares, change = memory.squares, memory.change
    while end - place.at[0] >= 2 and segments.size[0] + 4 < len(segments.tick):
        vast, k = memory.vast[slot], place.at[0]
        settles = vast == 1 and place.at[5] >= _CALM
        if deepens(place, end, vast):
            break
        if settles and k >= again and end - k >= BLOCK:
            if vast_blocks(z, place, slot, watches, end, segments, memory):
                continue
            # What is near its bound now is so for a while.
            again, k = place.at[0] + 4 * BLOCK, place.at[0]
        if place.at[5] >= FINE and k >= later and end - k >= FINE:
            limit = min(COARSE, (end - k) // FINE)
            clean = clean_ticks(
                lifted, lifted.coarse, lifted.sizes, slot, watches, COARSE, limit, low, high, slack, settles, squares,
                change, z, out,
            )  # fmt: skip
            if clean > 0:
                note(segments, k, slot, z)
                jump(n, lifted.jump_coarse, slot, COARSE, clean, z, change)
                k += clean * FINE
                place.at[0], place.at[5] = k, place.at[5] + clean * FINE
            if clean == limit:
                continue
            later, wait = (k + wait, min(2 * wait + FINE, _LONGEST)) if clean == 0 else (k, 0)
        limit = min(FINE, end - k)
        clean = clean_ticks(
            lifted, lifted.fine, lifted.sizes, slot, watches, FINE, limit, low, high, slack, settles, squares,
            change, z, out,
        )  # fmt: skip
        if clean > 0:
            note(segments, k, slot, z)
            jump(n, lifted.jump_fine, slot, FINE, clean, z, change)
            place.at[0], place.at[5] = k + clean, place.at[5] + clean
        if clean < limit:
            break
    return place.at[0] - begin


@bare
def run_lifted(
    t: Tables,
    loop: LiftedLoop,
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
        least = _LASTS if places.counted >= 0 and at[8] < _LASTS else 1
        if at[5] >= least and end - at[0] >= 2:
            slot = slot_of(at[1], at[2] == 1, at[3])
            at[6] = 1 if deepens(place, end, memory.vast[slot]) else 0
            if memory.filled[slot] <= at[6]:
                return UNFILLED
            if at[6] == 1:
                memory.vast[slot] = 1
            watches = set_bounds(t, loop, places, place, memory)
            if advance_block(z, place, watches, end, segments, memory) > 0:
                if at[0] >= end:
                    break
                set_reference(places, coefficients, at[0] / rate - origin, z)
                if deepens(place, end, memory.vast[slot]):
                    continue
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
        if places.counted >= 0 and at[7] == 0:
            alike, at[8] = False, at[5]
        at[5] = at[5] + 1 if alike else 0
        at[0] += 1
    return DONE
