"""Motion of a load behind an elastic shaft with backlash, under a given motion of the motor; compiled.

Between two samples the motor's angle is a cubic, straight in each part of a sample. In contact the load is a linear
system driven by the motor, in the gap a free one: both advance by matrix exponentials. Where a flank is touched or left
within a sample, the instant is the root of a polynomial, the Taylor series of the flow. In the gap the stretch that is
left in the shaft fades on its own, often far faster than anything else moves: it has its own exponential beside the
series.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.compiled import bare, inlined, subroutine
from servotwin.plant.signals import Array

_TERMS = 14
_CHANGES = 8  # within a sample; a load at rest on a flank could touch and leave it for ever
_ROUNDS = 60
_EXACT = 1e-13  # of an interval: a shorter step to an instant is the last
AFTER = _TERMS
"""Row of the scratch that has the state at the end of a part."""


@subroutine
def series(flow: Array, state: Array, terms: Array) -> None:
    """Taylor coefficients (terms, size) of the flow from a state (size,); its last two states are constant."""
    size, moving = state.size, state.size - 2
    for j in range(size):
        terms[0, j] = state[j]
    for k in range(1, _TERMS):
        terms[k, moving] = terms[k, moving + 1] = 0.0
        for i in range(moving):
            total = 0.0
            for j in range(size):
                total += flow[i, j] * terms[k - 1, j]
            terms[k, i] = total / k


@subroutine
def value(polynomial: Array, time: float) -> float:
    """A polynomial (terms,), ascending, at a time."""
    total = 0.0
    for k in range(_TERMS - 1, -1, -1):
        total = total * time + polynomial[k]
    return total


@subroutine
def slope(polynomial: Array, time: float) -> float:
    """Derivative of a polynomial (terms,), ascending, at a time."""
    total = 0.0
    for k in range(_TERMS - 1, 0, -1):
        total = total * time + k * polynomial[k]
    return total


@subroutine
def faded(stretch: float, fading: float, time: float) -> float:
    """Change of a stretch that fades at a rate (1/s), after a time."""
    return stretch * math.expm1(-fading * time)


@subroutine
def first_fall(polynomial: Array, stretch: float, fading: float, end: float) -> float:
    """Time in [0, end] at which a polynomial and what a stretch has faded, negative at the end, fall below zero.

    Newton's method; a step that leaves the bracket, or shortens it too little, is replaced by its middle.
    """
    low, high, time, before = 0.0, end, end, 2.0 * end
    for _ in range(_ROUNDS):
        here = value(polynomial, time) + faded(stretch, fading, time)
        if here >= 0.0:
            low = time
        else:
            high = time
        falling = slope(polynomial, time) - fading * stretch * math.exp(-fading * time)
        step = -here / falling if falling != 0.0 else math.inf
        if not low < time + step < high or abs(step) > 0.5 * before:
            step = 0.5 * (low + high) - time
        time, before = time + step, abs(step)
        if before <= _EXACT * end:
            break
    return time


@inlined
def advance(step: Array, state: Array, out: Array) -> None:
    """State (size,) one matrix (size, size) later; its last two states are constant."""
    size, moving = state.size, state.size - 2
    out[moving], out[moving + 1] = state[moving], state[moving + 1]
    for i in range(moving):
        total = 0.0
        for j in range(size):
            total += step[i, j] * state[j]
        out[i] = total


@inlined
def drive_to(state: Array, side: int, drive: float, rate: float, half: float, kept: int) -> None:
    """Set the driven end in contact: its position and rate, states `kept` and the next."""
    if side != 0:
        state[kept] = drive - side * half
        state[kept + 1] = rate


@inlined
def guard(side: int, drive: float, state: Array, push: Array, half: float) -> float:
    """Positive while the mode lasts: force on the flank, or the shorter way to one."""
    kept = state.size - 3
    if side != 0:
        total = 0.0
        for j in range(state.size):
            total += push[j] * state[j]
        return side * total
    return half - abs(drive - state[kept])


@subroutine
def guard_series(
    side: int, ahead: int, drive: float, rate: float, terms: Array, push: Array, half: float, out: Array
) -> None:
    """The guard as a polynomial; in the gap that of the flank on side `ahead`."""
    size = terms.shape[1]
    for k in range(_TERMS):
        total = 0.0
        if side != 0:
            for j in range(size):
                total += push[j] * terms[k, j]
            out[k] = side * total
        else:
            out[k] = ahead * terms[k, size - 3]
    if side == 0:
        out[0] += half - ahead * drive
        out[1] -= ahead * rate


@subroutine
def later(terms: Array, time: float, out: Array) -> None:
    """State (size,) at a time, from its Taylor coefficients."""
    for j in range(out.size):
        total = 0.0
        for k in range(_TERMS - 1, -1, -1):
            total = total * time + terms[k, j]
        out[j] = total


@inlined
def slowed(speed: float, friction: float) -> float:
    """A speed less what Coulomb friction takes of it at most."""
    return speed - min(max(speed, -friction), friction)


@subroutine
def through_changes(
    side: int,
    begin: float,
    end: float,
    interval: float,
    half: float,
    flows: Array,
    push: Array,
    fading: float,
    work: Array,
    state: Array,
) -> int:
    """Advance the state by one interval in which flanks are touched or left; return the flank at its end.

    The state at the end is in `work[AFTER]`, where that of a step without changes was. The other arguments are those
    of `through_sample`.
    """
    kept, rate = state.size - 3, (end - begin) / interval
    terms, after, polynomial = work[:_TERMS], work[AFTER], work[_TERMS + 1 :].reshape(-1)
    now, left = begin, interval
    for change in range(_CHANGES):
        series(flows[1 if side != 0 else 0], state, terms)
        stretch = state[kept] - state[0] if side == 0 else 0.0
        if change > 0:
            later(terms, left, after)
            after[kept] += faded(stretch, fading, left)
            if guard(side, end, after, push, half) >= 0.0 or change == _CHANGES - 1:
                break
        ahead = 1 if end > after[kept] else -1
        guard_series(side, ahead, now, rate, terms, push, half, polynomial)
        time = first_fall(polynomial, ahead * stretch, fading, left)
        later(terms, time, state)
        now += rate * time
        left -= time
        side = ahead if side == 0 else 0
        drive_to(state, side, now, rate, half, kept)
    return side


@inlined
def through_sample(
    side: int,
    begin: float,
    end: float,
    interval: float,
    half: float,
    flows: Array,
    steps: Array,
    push: Array,
    fading: float,
    work: Array,
    state: Array,
) -> int:
    """Advance the state by one interval in which the motor moves from `begin` to `end`; return the flank at its end.

    The other arguments are those of `run_shaft`.
    """
    after = work[AFTER]
    advance(steps[1 if side != 0 else 0], state, after)
    if guard(side, end, after, push, half) < 0.0:
        side = through_changes(side, begin, end, interval, half, flows, push, fading, work, state)
    for j in range(state.size):
        state[j] = after[j]
    return side


@inlined
def unused_friction(speed: float, friction: float) -> float:
    """Part of Coulomb friction that is left where it stops a mass."""
    return max(0.0, friction - abs(speed))


@inlined
def rested(begin: float, end: float, speed: float, unused: float) -> float:
    """Place at the end of a part of a mass that friction stopped in the half before, and had so much `unused`."""
    if unused > 0.0:
        share = 1.0 - 2.0 * unused / abs(speed) if abs(speed) > 2.0 * unused else 0.0
        end = begin + share * (end - begin)
    return end


@inlined
def slow_before(state: Array, friction: float) -> float:
    """Apply friction to the last mass before a part; return what is left of it where it stops the mass."""
    last = state.size - 4
    speed = state[last]
    state[last] = slowed(speed, friction)
    return unused_friction(speed, friction)


@inlined
def slow_after(state: Array, place: float, unused: float, friction: float) -> None:
    """Apply friction after a part that the last mass began at a place: `friction` and what is left of that before.

    A mass that friction holds rests where it is. All is continuous in every number: a mass that stopped in the half
    before is taken for one that rested as far as friction was left.
    """
    n = (state.size - 3) // 2
    speed = state[2 * n - 1]
    state[n - 1] = rested(place, state[n - 1], speed, unused)
    state[2 * n - 1] = slowed(speed, friction + unused)


@inlined
def between(drive: Array, i: int, share: float) -> float:
    """Motor's position at a share of the way from sample `i` to the next, by a cubic with the slopes that the samples
    on either side give it (Catmull and Rom)."""
    here, there = drive[i], drive[i + 1]
    first = 0.5 * (there - drive[i - 1]) if i > 0 else there - here
    last = 0.5 * (drive[i + 2] - here) if i + 2 < drive.size else there - here
    moved = there - here
    bend, twist = 3.0 * moved - 2.0 * first - last, first + last - 2.0 * moved
    return here + share * (first + share * (bend + share * twist))


@bare
def run_shaft(
    drive: Array,
    parts: int,
    interval: float,
    half: float,
    flows: Array,
    steps: Array,
    push: Array,
    fading: float,
    measured: Array,
    gains: tuple[float, float],
    friction: float,
    work: Array,
    state: Array,
    motion: Array,
    sides: NDArray[np.int8],
) -> None:
    """Simulate the load; one of one mass by `run_one_mass`.

    Parameters
    ----------
    drive : (N,) array
        Motor's position seen at the load, m or rad.
    parts : int
        Of a sample, one after the other; in each the motor moves evenly.
    interval, half : float
        s, of a part; and half of the gap at the load.
    flows, steps : (2, size, size) arrays
        Flow and its exponential over a part, in the gap and in contact, of (q (n), v (n), driven end, its rate, 1);
        size = 2 n + 3. In the gap only the exponential has the fading of the stretch.
    push : (size,) array
        Row of the shaft's force on the load in contact.
    fading : float
        Rate at which the stretch of the shaft fades in the gap, 1/s; 0: of a shaft without damping nothing is left.
    measured : (N,) array
        Measured position.
    gains : (float, float)
        Shares of the measured position less the simulated one that are added to the last mass's position, and to its
        speed (1/s); 0: none.
    friction : float
        Speed that Coulomb friction takes off the last mass in half a part at most: before each, and after it.
    work : (18, size) array
        Scratch.
    state : (size,) array
        At the first sample, with the driven end at the first mass; changed.
    motion : (3, N) array
        Out: position and velocity of the last mass, driven end.
    sides : (N,) int8 array
        Out: flank in contact, -1, 0 or 1.
    """
    n, kept = (state.size - 3) // 2, state.size - 3
    lead = drive[0] - state[kept]
    side = 0 if abs(lead) <= half else (1 if lead > 0.0 else -1)
    for i in range(drive.size):
        end = between(drive, i, 1.0 / parts) if i + 1 < drive.size else drive[i]
        drive_to(state, side, drive[i], (end - drive[i]) / interval, half, kept)
        error = measured[i] - state[n - 1]
        motion[0, i], motion[1, i], motion[2, i] = state[n - 1], state[2 * n - 1], state[kept]
        sides[i] = side
        state[n - 1] += gains[0] * error
        state[2 * n - 1] += gains[1] * error
        if i + 1 == drive.size:
            break
        begin = drive[i]
        for k in range(parts):
            end = between(drive, i, (k + 1.0) / parts)
            drive_to(state, side, begin, (end - begin) / interval, half, kept)
            place, unused = state[n - 1], slow_before(state, friction)
            side = through_sample(side, begin, end, interval, half, flows, steps, push, fading, work, state)
            slow_after(state, place, unused, friction)
            begin = end
