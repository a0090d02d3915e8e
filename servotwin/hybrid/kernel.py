"""The compiled kernel: exact flow, events located to rounding, none missed.

A *place* is a search step and a fraction of it in [0, 1); time is ``(step + fraction) * h``. Between events the state
is advanced by tables of ``exp(A t) - I``; a guard is looked at as in `tables`, coarse first, and wherever it might
become positive again at the next finer scale, down to its Taylor polynomial inside one step, whose first root is the
event.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.compiled import bare, inlined
from servotwin.hybrid.polynomial import first_positive
from servotwin.hybrid.tables import NODES_COARSE, NODES_FINE, PART_TERMS, PARTS, PIECES, TERMS, Tables

DONE, FULL, ZENO = 0, 1, 2
# More events than this inside one search step, or mode changes at one instant, is Zeno behaviour or sliding.
EVENTS_PER_STEP = 1000
CHANGES_AT_ONCE = 64
# A guard value or derivative below this part of its own terms is rounding, hence zero.
SIGNIFICANT = 1e-13


class Record(NamedTuple):
    """Growing output: segments (start of a stretch of one flow) and events; ``size[0]`` segments and ``size[1]`` events
    are filled."""

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


class Scratch(NamedTuple):
    """Working memory of one run."""

    rows: Array
    series: Array
    change: Array
    terms: Array
    starts: Array
    ends: Array


@inlined
def product(table: Array, base: int, stride: int, rows: int, x: Array, out: Array) -> None:
    """``out[r] = sum of table[base + j * stride + r] * x[j]``: four columns at a time, so that `out` is stored less
    often."""
    count, n, step = np.uint64(rows), np.uint64(x.size), np.uint64(stride)
    at: Any = np.uint64(base)
    fours = n // np.uint64(4)
    for r in range(count):
        out[r] = 0.0
    for block in range(fours):
        j = block * np.uint64(4)
        x0, x1, x2, x3 = x[j], x[j + np.uint64(1)], x[j + np.uint64(2)], x[j + np.uint64(3)]
        b = at + step
        c = b + step
        d = c + step
        for r in range(count):
            out[r] += (table[at + r] * x0 + table[b + r] * x1) + (table[c + r] * x2 + table[d + r] * x3)
        at = d + step
    for rest in range(fours * np.uint64(4), n):
        factor = x[rest]
        for r in range(count):
            out[r] += table[at + r] * factor
        at += step


@inlined
def advance(table: Array, base: int, x: Array, change: Array) -> None:
    """``x += P @ x`` with the transposed ``(n, n)`` matrix at `base`."""
    product(table, base, x.size, x.size, x, change)
    for i in range(np.uint64(x.size)):
        x[i] += change[i]


@inlined
def advance_fraction(t: Tables, mode: int, x: Array, fraction: float, scratch: Scratch) -> None:
    """Advance by ``fraction`` of a step: a tabled part, then a short Taylor series."""
    n = np.uint64(t.states)
    n2 = t.states * t.states
    part = min(int(fraction * PARTS), PARTS - 1)
    rest = fraction * PARTS - part
    if part > 0:
        advance(t.jump_part, (mode * PARTS + part) * n2, x, scratch.change)
    terms = scratch.terms
    product(t.flow_part, mode * n2 * PART_TERMS, t.states * PART_TERMS, t.states * PART_TERMS, x, terms)
    at = np.uint64(PART_TERMS * t.states)
    change = scratch.change
    for i in range(n):
        change[i] = 0.0
    for _ in range(PART_TERMS):
        at -= n
        for i in range(n):
            change[i] = (change[i] + terms[at + i]) * rest
    for i in range(n):
        x[i] += change[i]


@inlined
def advance_clean(
    t: Tables, table: Array, jumps: Array, nodes: int, wanted: int, mode: int, x: Array, scratch: Scratch
) -> int:
    """Advance through the first intervals of a block, at most `wanted`, in which no guard may become positive.

    `table` and `jumps` are those of one scale; returns the number of intervals advanced.
    """
    out, guards = scratch.rows, t.guard_count[mode]
    rows = 3 * nodes + 1
    product(table, mode * t.states * t.guards * rows, t.guards * rows, guards * rows, x, out)
    positive = 0
    for r in range(np.uint64(guards * rows)):
        positive += out[r] > 0.0
    clean = wanted if positive == 0 else clean_intervals(out, guards, rows, wanted)
    if clean > 0:
        advance(jumps, (mode * nodes + clean - 1) * t.states * t.states, x, scratch.change)
    return clean


@inlined
def clean_intervals(out: Array, guards: int, rows: int, wanted: int) -> int:
    """Number of intervals, at most `wanted`, before the first in which some guard may become positive."""
    clean = wanted
    for g in range(guards):
        for k in range(clean):
            at = g * rows + 3 * k
            if max(out[at], out[at + 1], out[at + 2], out[at + 3]) > 0.0:
                clean = k
                break
    return clean


@inlined
def rounding(t: Tables, mode: int, guard: int, x: Array) -> float:
    """The part of a guard's Taylor coefficients (in steps) that is rounding: of all the terms that ever enter them."""
    size = 0.0
    base = np.uint64((mode * t.guards + guard) * t.states)
    for i in range(np.uint64(t.states)):
        size += t.sizes[base + i] * abs(x[i])
    return SIGNIFICANT * size


@inlined
def series(t: Tables, mode: int, guard: int, x: Array, c: Array) -> int:
    """Fill `c` with the Taylor coefficients of a guard over a step; return the order of the first that is not
    rounding."""
    product(t.taylor, (mode * t.guards + guard) * t.states * TERMS, TERMS, TERMS, x, c)
    limit = rounding(t, mode, guard, x)
    for order in range(TERMS):
        if abs(c[order]) > limit:
            return order
    return TERMS


@inlined
def is_leaving(t: Tables, mode: int, guard: int, x: Array, c: Array) -> bool:
    """Whether the guard is positive now or at once: the sign of its first Taylor coefficient that is not rounding."""
    value = 0.0
    base = np.uint64((mode * t.guards + guard) * t.states)
    for i in range(np.uint64(t.states)):
        value += t.rows[base + i] * x[i]
    if abs(value) > rounding(t, mode, guard, x):
        return value > 0.0
    first = series(t, mode, guard, x, c)
    return first < TERMS and c[first] > 0.0


@inlined
def next_crossing(t: Tables, mode: int, guard: int, x: Array, length: float, scratch: Scratch) -> float:
    """First time in (0, length] steps at which the guard becomes positive, 0 when it is leaving now, inf when it does
    not."""
    value, change = 0.0, 0.0
    base = np.uint64((mode * t.guards + guard) * t.states)
    for i in range(np.uint64(t.states)):
        value += t.rows[base + i] * x[i]
        change += t.changes[base + i] * abs(x[i])
    if value + change < 0.0:
        # Not even with every term of the series at its worst.
        return np.inf
    c = scratch.series
    first = series(t, mode, guard, x, c)
    if first == TERMS:
        return np.inf
    if c[first] > 0.0:
        return 0.0
    # Leading zeros are divided out: the guard starts at zero and moves away.
    power = 1.0
    for k in range(TERMS - first):
        c[k] = c[k + first] * power
        power *= length
    for k in range(TERMS - first, TERMS):
        c[k] = 0.0
    return _search_unit(t, scratch) * length


@inlined
def _search_unit(t: Tables, scratch: Scratch) -> float:
    c, b = scratch.series, scratch.rows
    product(t.bernstein, 0, 3 * PIECES + 1, 3 * PIECES + 1, c, b)
    for piece in range(PIECES):
        at = 3 * piece
        if max(b[at], b[at + 1], b[at + 2], b[at + 3]) > 0.0:
            root = first_positive(c, piece / PIECES, (piece + 1) / PIECES, scratch.starts, scratch.ends)
            if root < np.inf:
                return root
    return np.inf


@inlined
def note_segment(record: Record, step: int, fraction: float, mode: int, x: Array) -> None:
    """Start a segment at a place."""
    at = record.size[0]
    record.step[at], record.fraction[at], record.mode[at] = step, fraction, mode
    for i in range(np.uint64(x.size)):
        record.state[at, i] = x[i]
    record.size[0] = at + 1


@inlined
def fire(
    t: Tables,
    mode: int,
    guard: int,
    x: Array,
    step: int,
    fraction: float,
    forced: bool,
    record: Record,
    scratch: Scratch,
) -> int:
    """Record the event, apply the guard's reset and return the mode entered."""
    at = record.size[1]
    record.event_step[at], record.event_fraction[at] = step, fraction
    record.event_mode[at], record.event_guard[at], record.event_forced[at] = mode, guard, forced
    record.size[1] = at + 1
    if t.has_reset[mode, guard]:
        advance(t.reset, (mode * t.guards + guard) * t.states * t.states, x, scratch.change)
    return t.target[mode, guard]


@inlined
def settle(
    t: Tables, mode: int, x: Array, step: int, fraction: float, forced: bool, record: Record, scratch: Scratch
) -> int:
    """Follow guards that are leaving at this very instant to a mode that admits flow; -1 when there is none."""
    for _ in range(CHANGES_AT_ONCE):
        leaving = -1
        for g in range(t.guard_count[mode]):
            if is_leaving(t, mode, g, x, scratch.series):
                leaving = g
                break
        if leaving < 0:
            return mode
        mode = fire(t, mode, leaving, x, step, fraction, forced, record, scratch)
    return -1


@inlined
def cross(
    t: Tables, mode: int, x: Array, step: int, start: float, end: float, record: Record, scratch: Scratch
) -> tuple[int, int]:
    """Advance from fraction `start` to `end` of one step through every event; return the mode (-1: Zeno) and the number
    of events."""
    place, before = start, record.size[1]
    while record.size[1] - before < EVENTS_PER_STEP:
        first, which = np.inf, -1
        for g in range(t.guard_count[mode]):
            time = next_crossing(t, mode, g, x, end - place, scratch)
            if time < first:
                first, which = time, g
        if which < 0:
            advance_fraction(t, mode, x, end - place, scratch)
            return mode, record.size[1] - before
        advance_fraction(t, mode, x, first, scratch)
        place = min(place + first, end)
        mode = fire(t, mode, which, x, step, place, False, record, scratch)
        mode = settle(t, mode, x, step, place, False, record, scratch)
        if mode < 0:
            break
        note_segment(record, step, place, mode, x)
    return -1, record.size[1] - before


@inlined
def step_once(t: Tables, mode: int, x: Array, step: int, record: Record, scratch: Scratch) -> int:
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


@bare
def flow_until(
    t: Tables,
    x: Array,
    mode: int,
    step: int,
    fraction: float,
    end_step: int,
    end_fraction: float,
    record: Record,
    scratch: Scratch,
) -> tuple[int, int, float, int]:
    """Advance `x` in place from one place to another.

    Returns status, place reached (of the failure when Zeno) and mode.
    """
    calm = 0
    room = len(record.step) - EVENTS_PER_STEP - 4
    room_events = len(record.event_step) - EVENTS_PER_STEP - CHANGES_AT_ONCE - 4
    note_segment(record, step, fraction, mode, x)
    while step < end_step or fraction < end_fraction:
        if record.size[0] > room or record.size[1] > room_events:
            return FULL, step, fraction, mode
        if fraction == 0.0 and calm >= NODES_FINE and end_step - step >= NODES_FINE:
            # Only after a while without events: what they excite may be fast.
            wanted = min(NODES_COARSE, (end_step - step) // NODES_FINE)
            clean = advance_clean(t, t.coarse, t.jump_coarse, NODES_COARSE, wanted, mode, x, scratch)
            if clean > 0:
                step += clean * NODES_FINE
                note_segment(record, step, 0.0, mode, x)
            if clean == wanted:
                continue
        if fraction == 0.0 and step < end_step:
            wanted = min(NODES_FINE, end_step - step)
            clean = advance_clean(t, t.fine, t.jump_fine, NODES_FINE, wanted, mode, x, scratch)
            if clean > 0:
                step += clean
                calm += clean
                note_segment(record, step, 0.0, mode, x)
            if clean == wanted:
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
    record: Record,
    scratch: Scratch,
) -> int:
    """Flow from jump to jump, apply each (NaN keeps a state), settle; the last row only marks the end.

    ``place = [fraction]`` and ``at = [step, mode, next jump, fresh]`` are updated in place, so that a run resumes when
    `record` has grown.
    """
    while True:
        if at[3] == 1:
            mode = settle(t, at[1], x, at[0], place[0], True, record, scratch)
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
