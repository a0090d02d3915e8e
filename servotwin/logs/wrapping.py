"""Angles that wrap: their turns counted, also through pauses, and a turn that only the jumps show."""

from __future__ import annotations

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.signals import Array

_DROPOUT = 5.0  # times the usual interval
_EDGE = 4  # samples on either side of a pause that show the speed
_FASTEST, _UNSURE = 0.99, 0.35  # quantile of the steps, and turns: beyond, half a turn more is not told from one less
NEAR_TURN = 0.2
"""Of a turn: a jump by a turn is one within so much."""
WITHIN = 1.01
"""Turns: the range of an angle that wraps."""
_WRAPS = 3  # jumps of about one turn that make an angle a wrapped one
_OF_RANGE, _STEPS = 0.8, 0.1  # of the range: jumps are larger, all other steps are smaller
_ALIKE, _SURE = 0.02, 0.8  # of a turn, between jumps; share of jumps against the motion
_TURNS = (1.0, 2.0 * np.pi, 100.0, 360.0, 400.0, 1000.0, 3600.0, 2e3 * np.pi, *(2.0**bits for bits in range(8, 33)))


def unwrapped_turns(name: str) -> str:
    """Name of the defect of an angle that wraps."""
    return f"turns of {name} that were unwrapped"


def unwrapped(angle: Array, turn: float) -> tuple[Array, int]:
    """The angle without its jumps by a turn, and their number; unchanged where it does not wrap."""
    steps = np.diff(angle)
    jumps = np.abs(np.abs(steps) - turn) < NEAR_TURN * turn
    within = angle.size > 0 and float(np.ptp(angle)) <= WITHIN * turn
    if not within or np.sum(jumps) < 1 or (np.sum(jumps) < _WRAPS and float(np.ptp(angle)) < 0.95 * turn):
        return angle, 0
    return np.unwrap(angle, period=turn), int(np.sum(jumps))


def check_followed(name: str, angle: Array, turn: float) -> None:
    """Refuse an angle that moves so far from sample to sample that its turns cannot be counted."""
    step = float(np.quantile(np.abs(np.diff(angle)), _FASTEST))
    if step > _UNSURE * turn:
        raise InvalidInput(
            f"the {name}'s angle wraps, and moves by up to {step / turn:.2f} turns from one sample to the next: its "
            "turns cannot be counted; record it unwrapped, or with more samples"
        )


def pauses(time: Array) -> list[int]:
    """Samples behind pauses of more than five usual intervals."""
    intervals = np.diff(time)
    usual = np.median(intervals) if intervals.size else 0.0
    return [int(row) + 1 for row in np.flatnonzero(intervals > _DROPOUT * usual)]


def with_turns_in_pauses(time: Array, angle: Array, turn: float) -> tuple[Array, list[float]]:
    """An unwrapped angle with the turns that it made in pauses, and the times behind those whose turns are not known.

    In a pause it goes on with the mean of the speeds before and behind it. By how much that is wrong shows wherever
    the log has no pause.
    """
    angle, lost, span = angle.copy(), list[float](), 2 * _EDGE
    usual = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    for row in pauses(time):
        length = float(time[row] - time[row - 1])
        grid = np.arange(time[0], time[-1], usual)
        steps = round(length / usual)
        whole = np.interp(grid, time, angle)
        speed = (whole[_EDGE:] - whole[:-_EDGE]) / _EDGE
        # From sample i to i + steps, with the speeds over _EDGE samples before i and behind i + steps.
        usable = whole.size - steps - span
        if row < _EDGE + 1 or row + _EDGE >= time.size or usable < steps:
            lost.append(float(time[row]))
            continue
        guesses = 0.5 * steps * (speed[:usable] + speed[_EDGE + steps :][:usable])
        wrong = np.abs(whole[_EDGE + steps :][:usable] - whole[_EDGE:][:usable] - guesses)
        if np.quantile(wrong, _FASTEST) > _UNSURE * turn:
            lost.append(float(time[row]))
            continue
        before = (angle[row - 1] - angle[row - 1 - _EDGE]) / (time[row - 1] - time[row - 1 - _EDGE])
        behind = (angle[row + _EDGE] - angle[row]) / (time[row + _EDGE] - time[row])
        guess = 0.5 * length * (before + behind) - (angle[row] - angle[row - 1])
        angle[row:] += turn * np.round(guess / turn)
    return angle, lost


def guessed_turn(values: Array) -> float | None:
    """Turn of a channel that wraps, in its own unit, as its jumps show it: from one end of its range to the other.

    A jump goes against the motion before and behind it; a machine that steps to and fro moves with its steps.
    """
    values = values[np.isfinite(values)]
    steps = np.diff(values)
    reach = float(np.ptp(values)) if values.size else 0.0
    jumps = np.flatnonzero(np.abs(steps) > _OF_RANGE * reach)
    jumps = jumps[(jumps > 0) & (jumps < steps.size - 1)]
    if jumps.size < _WRAPS or np.any(np.diff(jumps) < 2):
        return None
    others = np.abs(np.delete(steps, jumps))
    beside = 0.5 * (steps[jumps - 1] + steps[jumps + 1])
    turns = np.abs(steps[jumps] - beside)
    turn = float(np.median(turns))
    against = np.mean(beside * steps[jumps] < 0.0)
    if np.max(others) > _STEPS * reach or against < _SURE or np.median(np.abs(turns - turn)) > _ALIKE * turn:
        return None
    known = min(_TURNS, key=lambda each: abs(each / turn - 1.0))
    if abs(known / turn - 1.0) < _ALIKE and reach <= known * WITHIN:
        return known
    whole = bool(np.all(values == np.round(values)))
    return float(round(turn)) if whole else turn
