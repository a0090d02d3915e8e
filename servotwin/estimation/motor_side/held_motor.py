"""Motion of a motor and its load behind an elastic screw that the gap holds, under the motor's command; compiled.

In contact the screw moves with the motor's flank, and its spring acts back on the motor. A motor that the load stops
rests on the flank, while the screw carries the load, until its torque moves the load on or takes it off the flank. In
the gap the motor is alone. Each of the three has its matrix; changes within a part of a sample are placed by cubics.
"""

from __future__ import annotations

from typing import NamedTuple

from servotwin.hybrid.compiled import bare, inlined
from servotwin.plant.signals import Array

GAP, CONTACT, REST = range(3)
"""Places of the matrices."""

_CHANGES = 8  # within a part; a motor could touch and leave a flank for ever
_PLACED = 3  # times that the instant of a contact is improved


class HeldSteps(NamedTuple):
    """Exact steps over a part of a sample.

    Attributes
    ----------
    matrices : (3, M, M + 2) array
        In the gap, in contact, and of a motor that rests: of (d states of the motor, of which the last two are speed
        and place, n places and n speeds of the masses, the screw's place; command, 1), M = d + 2 n + 1.
    masses : int
        n.
    interval : float
        s, of a part.
    half : float
        Half gap at the load.
    friction, load_friction : float
        Speeds that Coulomb friction takes off motor and last mass in a part at most.
    """

    matrices: Array
    masses: int
    interval: float
    half: float
    friction: float
    load_friction: float


@inlined
def motor_of(by: HeldSteps, state: Array) -> tuple[int, int]:
    """Indices of the motor's speed and place in a state (M,)."""
    place = state.size - 2 * by.masses - 2
    return place - 1, place


@inlined
def taken_off(speed: float, friction: float) -> float:
    """Part of a speed that Coulomb friction takes off."""
    return min(max(speed, -friction), friction)


@inlined
def slow(ahead: Array, speed: int, place: int, lost: float, interval: float) -> None:
    """Take a speed off a state (M,), lost evenly within an interval."""
    ahead[speed] -= lost
    ahead[place] -= 0.5 * interval * lost


@inlined
def look_ahead(by: HeldSteps, which: int, command: float, state: Array, ahead: Array) -> None:
    """State (M,) a whole part later by one of the matrices, into `ahead`; friction of a moving motor may reverse it."""
    size = state.size
    for i in range(size):
        total = by.matrices[which, i, size] * command + by.matrices[which, i, size + 1]
        for j in range(size):
            total += by.matrices[which, i, j] * state[j]
        ahead[i] = total
    speed, place = motor_of(by, state)
    if state[speed] > 0.0:
        slow(ahead, speed, place, by.friction, by.interval)
    elif state[speed] < 0.0:
        slow(ahead, speed, place, -by.friction, by.interval)
    elif which != REST:
        slow(ahead, speed, place, taken_off(ahead[speed], by.friction), by.interval)
    last = size - 2
    slow(ahead, last, last - by.masses, taken_off(ahead[last], by.load_friction), by.interval)


@inlined
def on_cubic(place: float, speed: float, then: float, speed_then: float, share: float) -> float:
    """Place at a share of the way, by the cubic through both ends with their speeds (per whole way)."""
    moved = then - place
    bend, twist = 3.0 * moved - 2.0 * speed - speed_then, speed + speed_then - 2.0 * moved
    return place + share * (speed + share * (bend + share * twist))


@inlined
def part_way(by: HeldSteps, share: float, state: Array, ahead: Array, out: Array) -> None:
    """State (M,) at a share of the way from `state` to `ahead`."""
    if share == 1.0:
        for i in range(state.size):
            out[i] = ahead[i]
        return
    h, (speed, place) = by.interval, motor_of(by, state)
    for i in range(state.size):
        out[i] = state[i] + share * (ahead[i] - state[i])
    out[place] = on_cubic(state[place], h * state[speed], ahead[place], h * ahead[speed], share)
    for q in range(place + 1, place + 1 + by.masses):
        v = q + by.masses
        out[q] = on_cubic(state[q], h * state[v], ahead[q], h * ahead[v], share)


@inlined
def touching(by: HeldSteps, side: int, left: float, state: Array, ahead: Array) -> float:
    """Share of the way, at most `left`, at which the motor comes to a flank."""
    h, (speed, place) = by.interval, motor_of(by, state)
    way, share = state[-1] + side * by.half - state[place], left
    for _ in range(_PLACED):
        gone = on_cubic(state[place], h * state[speed], ahead[place], h * ahead[speed], share) - state[place]
        share = min(max(way * share / gone, 0.0), left) if gone != 0.0 else 0.0
    return share


@inlined
def put_on_flank(by: HeldSteps, side: int, state: Array) -> None:
    """Put the screw of a state (M,) on its flank in contact."""
    if side != 0:
        state[-1] = state[motor_of(by, state)[1]] - side * by.half


@inlined
def look_on(by: HeldSteps, side: int, command: float, state: Array, ahead: Array) -> int:
    """Look ahead as the motor goes on, on the flank of a side or in the gap (0); return which of the matrices it was.

    On its flank it moves on against the load, leaves it where it goes back without the load, and rests between the two.
    """
    speed = motor_of(by, state)[0]
    if side != 0:
        look_ahead(by, CONTACT, command, state, ahead)
        if side * state[speed] > 0.0 or side * ahead[speed] > 0.0:
            return CONTACT
    look_ahead(by, GAP, command, state, ahead)
    if side == 0 or side * state[speed] < 0.0 or side * ahead[speed] < 0.0:
        return GAP
    look_ahead(by, REST, command, state, ahead)
    return REST


@inlined
def through_part(by: HeldSteps, side: int, command: float, work: Array, state: Array) -> int:
    """Advance the state (M,) by a part of a sample; return the flank at its end. `work` (2, M) is scratch."""
    ahead, end, left = work[0], work[1], 1.0
    speed, place = motor_of(by, state)
    for _ in range(_CHANGES):
        which, moving, share = look_on(by, side, command, state, ahead), state[speed], left
        side = 0 if which == GAP else side
        part_way(by, left, state, ahead, end)
        lead = end[place] - state[-1]
        touches = which == GAP and abs(lead) > by.half
        stops = moving * end[speed] < 0.0 and (which == CONTACT or by.friction > 0.0)
        if touches:
            side = 1 if lead > 0.0 else -1
            share = touching(by, side, left, state, ahead)
            part_way(by, share, state, ahead, end)
            end[place] = state[-1] + side * by.half
        elif stops:
            share = left * moving / (moving - end[speed])
            part_way(by, share, state, ahead, end)
            end[speed] = 0.0
        for i in range(state.size):
            state[i] = end[i]
        put_on_flank(by, side, state)
        left -= share
        if not (touches or stops):
            break
    return side


@inlined
def observe(error: float, gains: Array, side: int, place: int, state: Array) -> None:
    """Move the state (M,) towards a measured place; a motor that rests shows nothing of its load, and stays at rest."""
    rests = state[place - 1] == 0.0
    mode = 1 if side != 0 and not rests else 0
    state[place] += gains[mode, 0] * error
    if not rests:
        state[place - 1] += gains[mode, 1] * error
    for j in range(2, gains.shape[1]):
        state[place - 1 + j] += gains[mode, j] * error


@bare
def run_held_motor(
    measured: Array,
    command: Array,
    parts: int,
    by: HeldSteps,
    gains: Array,
    work: Array,
    state: Array,
    predicted: Array,
    driven: Array,
) -> None:
    """Predict the motor's angle one sample ahead.

    Parameters
    ----------
    measured, command, parts, gains, predicted, driven
        As of `run_motor`.
    by : HeldSteps
    work : (2, M) array
        Scratch.
    state : (M,) array
        At the first sample; changed.
    """
    place = motor_of(by, state)[1]
    lead = state[place] - state[-1]
    side = 0 if abs(lead) < by.half else (1 if lead > 0.0 else -1)
    for i in range(measured.size):
        put_on_flank(by, side, state)
        predicted[i], driven[i] = state[place], state[-1]
        observe(measured[i] - state[place], gains, side, place, state)
        put_on_flank(by, side, state)
        if i + 1 == measured.size:
            break
        for _ in range(parts):
            side = through_part(by, side, command[i], work, state)
