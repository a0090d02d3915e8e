"""Cleaning of recorded samples: what is wrong is mended, left out or counted; nothing is refused for one sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.signals import Array

_Mask = np.ndarray[Any, np.dtype[np.bool_]]

_STALE = 50.0  # times the usual interval: a first sample so far before the others is an old one
_DROPOUT = 5.0  # times the usual interval
_EDGE = 4  # samples on either side of a pause that show the speed
_SPIKE = 20.0  # times the usual step between samples, there and back
_FASTEST, _UNSURE = 0.99, 0.35  # quantile of the steps, and turns: beyond, half a turn more is not told from one less
NEAR_TURN = 0.2
"""Of a turn: a jump by a turn is one within so much."""
WITHIN = 1.01
"""Turns: the range of an angle that wraps."""
_HELD_CHANGES, _HELD = 50, 0.9  # changes of a channel that is held, and share of them after equally many samples
_MEASURED = ("motor", "load")  # commands and references are held on purpose
_STEPS = (0.1, 0.9)  # quantiles of its steps, which differ
_WRAPS = 3  # jumps of about one turn that make an angle a wrapped one


class Cleaned(NamedTuple):
    """Samples in increasing time, all finite, and what was done to them.

    Attributes
    ----------
    time : (n,) array
        s.
    channels : mapping
        (n,) arrays by name.
    found : mapping
        Number of samples by defect, in words; only defects that occur.
    parted : list of float
        Times, s, of the samples behind pauses in which angles that wrap turned by nobody knows how much.
    """

    time: Array
    channels: Mapping[str, Array]
    found: Mapping[str, int]
    parted: Sequence[float] = ()


def cleaned(time: Array, channels: Mapping[str, Array], turns: Mapping[str, float], first: bool = True) -> Cleaned:
    """Leave out samples that are damaged, repeated, stale or out of order; unwrap angles; count all of it.

    Parameters
    ----------
    time : (n,) array
        s; NaN where the log has none.
    channels : mapping
        (n,) arrays by name.
    turns : mapping
        Full turn of the channels that are angles, in their units.
    first : bool
        The log begins here: a first sample long before the others is an old one.
    """
    found: dict[str, int] = {}
    names = list(channels)
    table = np.column_stack([time, *channels.values()])

    def keep(kept: _Mask, defect: str) -> None:
        nonlocal table
        if not kept.all():
            found[defect] = int(np.sum(~kept))
            table = table[kept]

    keep(np.isfinite(table.sum(axis=1)), "without a number in some column")
    if first and len(table) > 2:
        intervals = np.diff(table[:, 0])
        usual = float(np.median(np.abs(intervals)))
        stale = int(intervals[0] > _STALE * usual) if usual > 0.0 else 0
        kept = np.ones(len(table), dtype=np.bool_)
        kept[:stale] = False
        keep(kept, "stale, long before all others")
    latest = np.maximum.accumulate(table[:, 0]) if len(table) else table[:, 0]
    repeated = np.concatenate([[False], np.diff(latest) == 0.0])
    back = table[:, 0] < latest
    keep(~back, "earlier than the sample before")
    keep(~repeated[~back], "at the time of the sample before")
    parted: list[float] = []
    for place, name in enumerate(names, 1):
        if name in turns:
            table[:, place], count = _unwrapped(table[:, place], turns[name])
            if count:
                _check_followed(name, table[:, place], turns[name])
                table[:, place], lost = _bridged(table[:, 0], table[:, place], turns[name])
                parted += lost
                found[unwrapped_turns(name)] = count
    for place, name in enumerate(names, 1):
        keep(~_spikes(table[:, place]), f"spikes of {name}")
    # Counted only: to leave them out would cost every other channel its samples. What a hold delays is the fit's lag.
    for place, name in enumerate(names, 1):
        held = _repeats(table[:, place]) if name in _MEASURED else 0
        if held:
            found[f"repeats of a {name} that is written more often than it is measured"] = held
    if gaps := pauses(table[:, 0]):
        found["pauses longer than five intervals"] = len(gaps)
    return Cleaned(table[:, 0], {name: table[:, place] for place, name in enumerate(names, 1)}, found, parted)


def unwrapped_turns(name: str) -> str:
    """Name of the defect of an angle that wraps."""
    return f"turns of {name} that were unwrapped"


def _unwrapped(angle: Array, turn: float) -> tuple[Array, int]:
    """The angle without its jumps by a turn, and their number; unchanged where it does not wrap."""
    steps = np.diff(angle)
    jumps = np.abs(np.abs(steps) - turn) < NEAR_TURN * turn
    within = angle.size > 0 and float(np.ptp(angle)) <= WITHIN * turn
    if not within or np.sum(jumps) < 1 or (np.sum(jumps) < _WRAPS and float(np.ptp(angle)) < 0.95 * turn):
        return angle, 0
    return np.unwrap(angle, period=turn), int(np.sum(jumps))


def _check_followed(name: str, angle: Array, turn: float) -> None:
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


def _bridged(time: Array, angle: Array, turn: float) -> tuple[Array, list[float]]:
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


def _spikes(values: Array) -> _Mask:
    """Single samples that jump away and back by far more than the samples around them move."""
    if values.size < 5:
        return np.zeros(values.size, dtype=bool)
    steps = np.diff(values)
    usual = float(np.quantile(np.abs(steps), 0.99))
    there, back = steps[:-1], steps[1:]
    lonely = (np.minimum(np.abs(there), np.abs(back)) > _SPIKE * usual) & (np.abs(there + back) < 0.2 * np.abs(there))
    return np.concatenate([[False], lonely & (usual > 0.0), [False]])


def _repeats(values: Array) -> int:
    """Number of samples that repeat a value because the channel is written more often than it is measured.

    Its values last for the same number of samples at any speed, and change by different steps; those of an encoder
    with few counts last longer the slower it moves, and change by one count.
    """
    changes = np.flatnonzero(np.diff(values)) + 1
    if changes.size < _HELD_CHANGES:
        return 0
    lengths, steps = np.diff(changes), np.abs(np.diff(values))[changes - 1]
    usual = int(np.median(lengths))
    if usual < 2 or np.mean(lengths % usual == 0) < _HELD or np.ptp(np.quantile(steps, _STEPS)) <= 0.1 * steps.mean():
        return 0
    # A channel at rest goes on being measured: of a longer run one in so many samples is new.
    return int(np.sum(lengths - lengths // usual))
