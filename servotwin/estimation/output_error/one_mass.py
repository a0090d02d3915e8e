"""`run_shaft` for a load of one mass, to the last bit, in two thirds of the time: its state is in registers.

Nearly all loads are one mass, and a fit spends most of its time here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.output_error.shaft import (
    AFTER,
    between,
    rested,
    slowed,
    through_changes,
    unused_friction,
)
from servotwin.hybrid.compiled import bare, inlined
from servotwin.plant.signals import Array


@inlined
def along(row: Array, place: float, speed: float, end: float, rate: float) -> float:
    """A row (5,) times the state, summed in the order of `shaft.advance`."""
    return 0.0 + row[0] * place + row[1] * speed + row[2] * end + row[3] * rate + row[4]


@inlined
def keep(out: Array, place: float, speed: float, end: float, rate: float) -> None:
    """Write the state into an array (5,) whose last element is 1."""
    out[0], out[1], out[2], out[3], out[4] = place, speed, end, rate, 1.0


@bare
def run_one_mass(
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
    """Simulate the load; the arguments are those of `run_shaft`."""
    place, speed, driven, rate = state[0], state[1], state[2], state[3]
    after = work[AFTER]
    lead = drive[0] - driven
    side = 0 if abs(lead) <= half else (1 if lead > 0.0 else -1)
    for i in range(drive.size):
        driven = drive[i] - side * half if side != 0 else driven
        motion[0, i], motion[1, i], motion[2, i] = place, speed, driven
        sides[i] = side
        if i + 1 == drive.size:
            break
        error = measured[i] - place
        place, speed = place + gains[0] * error, speed + gains[1] * error
        begin = drive[i]
        for k in range(parts):
            end = between(drive, i, (k + 1.0) / parts)
            if side != 0:
                driven, rate = begin - side * half, (end - begin) / interval
            unused, speed = unused_friction(speed, friction), slowed(speed, friction)
            step = steps[1 if side != 0 else 0]
            there, quick = along(step[0], place, speed, driven, rate), along(step[1], place, speed, driven, rate)
            moved = along(step[2], place, speed, driven, rate)
            left = side * along(push, there, quick, moved, rate) if side != 0 else half - abs(end - moved)
            if left < 0.0:
                keep(state, place, speed, driven, rate)
                keep(after, there, quick, moved, rate)
                side = through_changes(side, begin, end, interval, half, flows, push, fading, work, state)
                there, quick, moved, rate = after[0], after[1], after[2], after[3]
            place, speed = rested(place, there, quick, unused), slowed(quick, friction + unused)
            driven, begin = moved, end
