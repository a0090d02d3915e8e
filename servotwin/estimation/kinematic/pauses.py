"""Pauses of a recording in which the motor may have reversed: what the play did there is not known."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.regression import SPAN
from servotwin.estimation.kinematic.strokes import counts_of
from servotwin.plant.signals import Array

_LONG = 5.0  # times the usual interval
_FAR, _FAST = 20.0, 0.99  # times that quantile of the motor's steps: a jump over a pause that the times do not show
_OF_STRETCH = 8
_EDGE = 4  # samples on either side that show the speed
_COUNTS, _SHARE = 4.0, 0.5  # counts, and share of the gap, by which the motor may move otherwise than its speeds say


def behind_pauses(recording: EncoderRecording, gap: float) -> Any:
    """(n,) true for samples next to a pause, and behind it until the motor has moved by the gap (its unit).

    Only pauses count over which the motor moved otherwise than its speeds before and behind them say: there it may
    have reversed.
    """
    time, motor = recording.time, recording.motor
    allowed = max(_COUNTS * counts_of(recording)[0], _SHARE * gap)
    result = np.zeros(motor.size, dtype=np.bool_)
    if recording.alone is not None:
        result |= beside_stretches(recording.alone)
    for row in pauses_of(time, motor):
        if result[row] or result[row - 1]:
            continue
        if row <= _EDGE or row + _EDGE >= motor.size:
            continue
        before, behind = _speed(time, motor, row - 1 - _EDGE), _speed(time, motor, row)
        guess = 0.5 * (before + behind) * (time[row] - time[row - 1])
        if abs(motor[row] - motor[row - 1] - guess) > allowed:
            result[max(row - SPAN, 0) : max(row + SPAN, _taken_up(motor, row, gap))] = True
    return result


def beside_stretches(alone: Any) -> Any:
    """(n,) true for samples between the stretches of a thinned log, and in the first and last eighth of a stretch.

    There neither difference quotients nor a lag that is fitted reach beyond the stretch.
    """
    result = alone.copy()
    steps = np.diff(alone.astype(np.int8), prepend=1, append=1)
    begins, ends = np.flatnonzero(steps == -1).tolist(), np.flatnonzero(steps == 1).tolist()
    for begin, end in zip(begins, ends, strict=True):
        edge = max(SPAN, (end - begin) // _OF_STRETCH)
        result[begin : begin + edge] = result[max(end - edge, 0) : end] = True
    return result


def pauses_of(time: Array, *positions: Array) -> list[int]:
    """Samples behind a pause, or behind a jump of a position."""
    intervals = np.diff(time)
    found = intervals > _LONG * np.median(intervals)
    for values in positions:
        steps = np.abs(np.diff(values))
        moving = steps[steps > 0.0]
        if moving.size:
            found |= steps > _FAR * float(np.quantile(moving, _FAST))
    return [int(row) + 1 for row in np.flatnonzero(found)]


def _speed(time: Array, motor: Array, begin: int) -> float:
    return float((motor[begin + _EDGE] - motor[begin]) / (time[begin + _EDGE] - time[begin]))


def _taken_up(motor: Array, begin: int, gap: float) -> int:
    """First sample from `begin` on by which the motor has moved by the gap."""
    size = 64
    while True:
        part = motor[begin : begin + size]
        reach = np.maximum.accumulate(part) - np.minimum.accumulate(part)
        if reach[-1] >= gap or begin + size >= motor.size:
            return begin + int(np.searchsorted(reach, gap))
        size *= 4
