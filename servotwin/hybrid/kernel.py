"""The compiled kernel: exact flow, events located to rounding, none missed.

A *place* is a search step and a fraction of it in [0, 1); time is ``(step + fraction) * h``. Between events the state
is advanced by tables of ``exp(A t) - I``; guards are checked as in `tables`, on the coarse scale first, and
wherever one might become positive again on the next finer scale, down to its Taylor polynomial inside one step, whose
first root is the event.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.build import fill_entered
from servotwin.hybrid.compiled import bare, inlined, merged, subroutine
from servotwin.hybrid.crossing import is_leaving, next_crossing
from servotwin.hybrid.flow import Scratch, advance, advance_clean, advance_fraction, product
from servotwin.hybrid.tables import NODES_COARSE, NODES_FINE, Tables

DONE, FULL, ZENO = 0, 1, 2
# More events than this inside one search step, or mode changes at one instant, is Zeno behaviour or sliding.
EVENTS_PER_STEP = 1000
CHANGES_AT_ONCE = 64
# After so many changes at one instant two modes take turns: each calls its guard's first derivative beyond rounding,
# and not the same one, because its coefficients, sums of terms that cancel, differ a little from the other's. They
# agree once a derivative must exceed its rounding by this factor.
_TURNS, _BEYOND = 8, 2.0


class RunRecord(NamedTuple):
    """Growing output of a run: segments (starts of one flow) and events; ``size[0]`` and ``size[1]`` are filled."""

    size: NDArray[np.int64]
    step: NDArray[np.int64]
    fraction: Array
    mode: NDArray[np.int64]
    state: Array
    event_step: NDArray[np.int64]
    event_fraction: Array
    event_mode: NDArray[np.int64]
    event_guard: NDArray[np.int64]
    event_forced: NDArray[np.bool_]


def new_record(states: int, segments: int = 4 * EVENTS_PER_STEP, events: int = 4 * EVENTS_PER_STEP) -> RunRecord:
    """An empty record with room for so many segments and events."""
    return RunRecord(
        np.zeros(2, dtype=np.int64),
        np.empty(segments, dtype=np.int64),
        np.empty(segments),
        np.empty(segments, dtype=np.int64),
        np.empty((segments, states)),
        np.empty(events, dtype=np.int64),
        np.empty(events),
        np.empty(events, dtype=np.int64),
        np.empty(events, dtype=np.int64),
        np.empty(events, dtype=bool),
    )


def grown(record: RunRecord) -> RunRecord:
    """A copy with twice the room."""
    larger = new_record(record.state.shape[1], 2 * len(record.step), 2 * len(record.event_step))
    for old, new in zip(record, larger, strict=True):
        new[: len(old)] = old
    return larger


@inlined
def note_segment(record: RunRecord, step: int, fraction: float, mode: int, x: Array) -> None:
    """Start a segment at a place."""
    at = record.size[0]
    record.step[at], record.fraction[at], record.mode[at] = step, fraction, mode
    for i in range(np.uint64(x.size)):
        record.state[at, i] = x[i]
    record.size[0] = at + 1


@merged
def fire(
    t: Tables,
    mode: int,
    guard: int,
    x: Array,
    step: int,
    fraction: float,
    forced: bool,
    record: RunRecord,
    scratch: Scratch,
) -> int:
    """Record the event, apply the guard's reset and return the mode entered."""
    at = record.size[1]
    record.event_step[at], record.event_fraction[at] = step, fraction
    record.event_mode[at], record.event_guard[at], record.event_forced[at] = mode, guard, forced
    record.size[1] = at + 1
    if t.has_reset[mode, guard]:
        advance(t.reset, (mode * t.guards + guard) * t.states * t.states, x, scratch.change)
    entered = t.target[mode, guard]
    if scratch.pending.filled[entered] == 0:
        fill_entered(t, entered, scratch.pending)
    return entered


@merged
def follow_guards(
    t: Tables,
    mode: int,
    x: Array,
    step: int,
    fraction: float,
    forced: bool,
    margin: float,
    record: RunRecord,
    scratch: Scratch,
) -> tuple[int, float]:
    """Follow guards that are leaving at this very instant to a mode that admits flow; return it, -1 when there is none,
    and the margin over rounding that was needed.

    A jump or a reset may make several guards positive at once; each change is an event of its own.
    """
    for change in range(CHANGES_AT_ONCE):
        if change == _TURNS:
            margin = max(margin, _BEYOND)
        # A literal is a type of its own to numba: `fire` would be compiled once more for it.
        leaving: Any = np.int64(-1)
        for g in range(t.guard_count[mode]):
            if is_leaving(t, mode, g, x, margin, scratch.series):
                leaving = g
                break
        if leaving < 0:
            return mode, margin
        mode = fire(t, mode, leaving, x, step, fraction, forced, record, scratch)
    return -1, margin


@merged
def cross(
    t: Tables, mode: int, x: Array, step: int, start: float, end: float, record: RunRecord, scratch: Scratch
) -> tuple[int, int]:
    """Advance from fraction `start` to `end` of one step through every event; return the mode (-1: Zeno) and the number
    of events."""
    place, before, margin = start, record.size[1], 1.0
    forced: Any = np.bool_(False)
    while record.size[1] - before < EVENTS_PER_STEP:
        # Every guard, because several may be crossed within the step: the earliest crossing is the event.
        first = np.inf
        which: Any = np.int64(-1)
        for g in range(t.guard_count[mode]):
            time = next_crossing(t, mode, g, x, end - place, margin, scratch)
            if time < first:
                first, which = time, g
        if which < 0:
            advance_fraction(t, mode, x, end - place, scratch)
            return mode, record.size[1] - before
        advance_fraction(t, mode, x, first, scratch)
        # Rounding of the sum must not put the event behind the end of this part of the step.
        place = min(place + first, end)
        mode = fire(t, mode, which, x, step, place, forced, record, scratch)
        mode, margin = follow_guards(t, mode, x, step, place, forced, margin, record, scratch)
        if mode < 0:
            break
        note_segment(record, step, place, mode, x)
    return -1, record.size[1] - before


@merged
def step_once(t: Tables, mode: int, x: Array, step: int, record: RunRecord, scratch: Scratch) -> int:
    """Advance `x` in place by one search step; return the mode, -1 when Zeno. One product when nothing happens."""
    n = np.uint64(t.states)
    stride = t.states + 4 * t.guards
    rows = np.uint64(t.states + 4 * t.guard_count[mode])
    out = scratch.rows
    product(t.single, mode * t.states * stride, stride, t.states + 4 * t.guard_count[mode], x, out)
    positive = 0
    for r in range(n, rows):
        positive += out[r] > 0.0
    if positive == 0:
        for i in range(n):
            x[i] += out[i]
        return mode
    mode, _ = cross(t, mode, x, step, 0.0, 1.0, record, scratch)
    return mode


@subroutine
def flow_until(
    t: Tables,
    x: Array,
    mode: int,
    step: int,
    fraction: float,
    end_step: int,
    end_fraction: float,
    record: RunRecord,
    scratch: Scratch,
) -> tuple[int, int, float, int]:
    """Advance `x` in place from one place to another.

    Returns status, place reached (of the failure when Zeno) and mode.
    """
    calm = 0  # search steps since the last event
    # Compiled code cannot enlarge the record: it returns FULL while one more step with all its events still fits.
    room = len(record.step) - EVENTS_PER_STEP - 4
    room_events = len(record.event_step) - EVENTS_PER_STEP - CHANGES_AT_ONCE - 4
    if record.size[0] > room or record.size[1] > room_events:
        return FULL, step, fraction, mode
    note_segment(record, step, fraction, mode, x)
    while step < end_step or fraction < end_fraction:
        if record.size[0] > room or record.size[1] > room_events:
            return FULL, step, fraction, mode
        if fraction == 0.0 and calm >= NODES_FINE and end_step - step >= NODES_FINE:
            # Only after a while without events: they may excite motions that are fast, and gone within a coarse step.
            intervals = min(NODES_COARSE, (end_step - step) // NODES_FINE)
            clean = advance_clean(t, t.coarse, t.jump_coarse, NODES_COARSE, intervals, mode, x, scratch)
            if clean > 0:
                step += clean * NODES_FINE
                note_segment(record, step, 0.0, mode, x)
            if clean == intervals:
                continue
        # The tables hold whole search steps, so they serve only a state on the grid of search steps.
        if fraction == 0.0 and step < end_step:
            intervals = min(NODES_FINE, end_step - step)
            clean = advance_clean(t, t.fine, t.jump_fine, NODES_FINE, intervals, mode, x, scratch)
            if clean > 0:
                step += clean
                calm += clean
                note_segment(record, step, 0.0, mode, x)
            if clean == intervals:
                continue
        stop = 1.0 if step < end_step else end_fraction
        mode, events = cross(t, mode, x, step, fraction, stop, record, scratch)
        if mode < 0:
            return ZENO, step, record.event_fraction[record.size[1] - 1], mode
        calm = 0 if events > 0 else calm + 1
        step, fraction = (step + 1, 0.0) if stop == 1.0 else (step, stop)
        note_segment(record, step, fraction, mode, x)
    return DONE, step, fraction, mode


@bare
def follow_schedule(
    t: Tables,
    x: Array,
    place: NDArray[np.float64],
    at: NDArray[np.int64],
    jump_step: NDArray[np.int64],
    jump_fraction: Array,
    jump_value: Array,
    jump_mode: NDArray[np.int64],
    record: RunRecord,
    scratch: Scratch,
) -> int:
    """Flow from jump to jump, apply each (NaN keeps a state), follow guards; the last row only marks the end.

    ``place = [fraction]`` and ``at = [step, mode, next jump, fresh]`` are updated in place, so that a run resumes when
    `record` has grown.
    """
    while True:
        # A start or a jump may have made guards positive: they are followed before anything flows.
        if at[3] == 1:
            forced: Any = np.bool_(True)
            mode, _ = follow_guards(t, at[1], x, at[0], place[0], forced, 1.0, record, scratch)
            if mode < 0:
                return ZENO
            at[1], at[3] = mode, 0
        j = at[2]
        status, at[0], place[0], at[1] = flow_until(
            t, x, at[1], at[0], place[0], jump_step[j], jump_fraction[j], record, scratch
        )
        if status != DONE:
            return status
        at[2] = j + 1
        if at[2] == len(jump_step):
            return DONE
        for i in range(t.states):
            if not np.isnan(jump_value[j, i]):
                x[i] = jump_value[j, i]
        at[1] = jump_mode[j, at[1]]
        at[3] = 1
