"""Motion of a load behind an elastic shaft with backlash, under a given motion of the motor; compiled.

Between two samples the motor's angle is linear. In contact the load is a linear system driven by the motor, in the gap
a free one: both advance by matrix exponentials. Where a flank is touched or left within a sample, the instant is the
root of a polynomial, the Taylor series of the flow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.compiled import bare
from servotwin.plant.signals import Array

_TERMS = 14
_CHANGES = 8  # within a sample; a load at rest on a flank could touch and leave it for ever
_ROUNDS = 60


@bare
def series(flow: Array, state: Array, terms: Array) -> None:
    """Taylor coefficients (terms, size) of the flow from a state (size,)."""
    size = state.size
    for j in range(size):
        terms[0, j] = state[j]
    for k in range(1, _TERMS):
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += flow[i, j] * terms[k - 1, j]
            terms[k, i] = total / k


@bare
def value(polynomial: Array, time: float) -> float:
    """A polynomial (terms,), ascending, at a time."""
    total = 0.0
    for k in range(_TERMS - 1, -1, -1):
        total = total * time + polynomial[k]
    return total


@bare
def first_fall(polynomial: Array, end: float) -> float:
    """Time in [0, end] at which a polynomial that is negative at the end falls below zero."""
    low, high = 0.0, end
    for _ in range(_ROUNDS):
        middle = 0.5 * (low + high)
        if value(polynomial, middle) >= 0.0:
            low = middle
        else:
            high = middle
        if high - low <= 1e-13 * end:
            break
    return high


@bare
def advance(step: Array, state: Array, out: Array) -> None:
    """State (size,) one matrix (size, size) later."""
    for i in range(state.size):
        total = 0.0
        for j in range(state.size):
            total += step[i, j] * state[j]
        out[i] = total


@bare
def drive_to(state: Array, side: int, drive: float, rate: float, half: float, kept: int) -> None:
    """Set the driven end in contact: its position and rate, states `kept` and the next."""
    if side != 0:
        state[kept] = drive - side * half
        state[kept + 1] = rate


@bare
def guard(side: int, drive: float, state: Array, push: Array, half: float) -> float:
    """Positive while the mode lasts: force on the flank, or the shorter way to one."""
    kept = state.size - 3
    if side != 0:
        total = 0.0
        for j in range(state.size):
            total += push[j] * state[j]
        return side * total
    return half - abs(drive - state[kept])


@bare
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


@bare
def run_shaft(
    drive: Array,
    interval: float,
    half: float,
    flows: Array,
    steps: Array,
    push: Array,
    measured: Array,
    gains: tuple[float, float],
    friction: float,
    work: Array,
    state: Array,
    motion: Array,
    sides: NDArray[np.int8],
) -> None:
    """Simulate the load.

    Parameters
    ----------
    drive : (N,) array
        Motor's position seen at the load, m or rad.
    interval : float
        s.
    half : float
        Half of the gap at the load.
    flows, steps : (2, size, size) arrays
        Flow and its exponential over one interval, in the gap and in contact, of (q (n), v (n), driven end, its rate,
        1); size = 2 n + 3.
    push : (size,) array
        Row of the shaft's force on the load in contact.
    measured : (M,) array
        Measured position at every ((N - 1) / (M - 1))-th sample.
    gains : (float, float)
        Shares of the measured position less the simulated one that are added to the last mass's position, and to its
        speed (1/s); 0: none.
    friction : float
        Speed that Coulomb friction takes off the last mass in one interval; after each it takes that much at most.
    work : (18, size) array
        Scratch.
    state : (size,) array
        At the first sample, with the driven end at the first mass; changed.
    motion : (3, N) array
        Out: position and velocity of the last mass, driven end.
    sides : (N,) int8 array
        Out: flank in contact, -1, 0 or 1.
    """
    size = state.size
    n, kept = (size - 3) // 2, size - 3
    terms, after, polynomial = work[:_TERMS], work[_TERMS], work[_TERMS + 1 :].reshape(-1)
    side, part = 0, (drive.size - 1) // (measured.size - 1)
    if drive[0] - state[kept] > half:
        side = 1
    elif state[kept] - drive[0] > half:
        side = -1
    for i in range(drive.size):
        rate = (drive[i + 1] - drive[i]) / interval if i + 1 < drive.size else 0.0
        drive_to(state, side, drive[i], rate, half, kept)
        error = measured[i // part] - state[n - 1] if i % part == 0 else 0.0
        motion[0, i], motion[1, i], motion[2, i] = state[n - 1], state[2 * n - 1], state[kept]
        sides[i] = side
        state[n - 1] += gains[0] * error
        state[2 * n - 1] += gains[1] * error
        if i + 1 == drive.size:
            break
        now, left = drive[i], interval
        for change in range(_CHANGES):
            flow = flows[1] if side != 0 else flows[0]
            if change == 0:
                advance(steps[1] if side != 0 else steps[0], state, after)
                if guard(side, drive[i + 1], after, push, half) >= 0.0:
                    break
            series(flow, state, terms)
            if change > 0:
                for j in range(size):
                    total = 0.0
                    for k in range(_TERMS - 1, -1, -1):
                        total = total * left + terms[k, j]
                    after[j] = total
                if guard(side, drive[i + 1], after, push, half) >= 0.0 or change == _CHANGES - 1:
                    break
            ahead = 1 if drive[i + 1] > after[kept] else -1
            guard_series(side, ahead, now, rate, terms, push, half, polynomial)
            time = first_fall(polynomial, left)
            for j in range(size):
                total = 0.0
                for k in range(_TERMS - 1, -1, -1):
                    total = total * time + terms[k, j]
                state[j] = total
            now += rate * time
            left -= time
            side = ahead if side == 0 else 0
            drive_to(state, side, now, rate, half, kept)
        for j in range(size):
            state[j] = after[j]
        speed = state[2 * n - 1]
        state[2 * n - 1] = speed - min(max(speed, -friction), friction)
