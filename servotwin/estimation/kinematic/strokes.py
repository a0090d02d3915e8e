"""Strokes: the parts of a recording between two reversals of its motor."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.hybrid.compiled import compiled
from servotwin.plant.signals import Array


@compiled
def play_and_side(motor: Array, gap: float, side: Any) -> Array:
    """Play of the motor's angle; `side` (n,) int8 becomes the flank that was touched last, 0 before the first contact.

    Before the first contact the output is not known: it is taken as the middle of the gap.
    """
    output = np.empty_like(motor)
    half, now, touched = 0.5 * gap, motor[0], 0
    low = high = motor[0]
    for i in range(motor.size):
        angle = motor[i]
        low, high = min(low, angle), max(high, angle)
        if touched == 0 and high - low >= gap:
            # The screw was somewhere within half a gap of the first angle: from here on it is known.
            touched = 1 if angle == high else -1
            now = angle - half * touched
        elif touched != 0:
            if angle - half > now:
                now, touched = angle - half, 1
            elif angle + half < now:
                now, touched = angle + half, -1
        output[i] = now
        side[i] = touched
    return output


class Strokes(NamedTuple):
    """Parts of a recording between reversals.

    Attributes
    ----------
    begin : (m,) int array
        First sample of each; a stroke begins where the motor has reversed.
    side : (m,) int array
        Direction of each, +1 or -1.
    """

    begin: Array
    side: Array

    @property
    def reversals(self) -> int:
        return len(self.side) - 1


def resolution(values: Array) -> float:
    """The encoder's count: the smallest step between different values that is more than rounding; 0 for a constant."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-9 * np.ptp(values)] if values.size > 1 else steps
    return float(np.quantile(steps, 0.01)) if steps.size else 0.0


def noise_of(values: Array) -> float:
    """Standard deviation of what differs from sample to sample."""
    second = np.diff(values, 2)
    return 1.4826 * float(np.median(np.abs(second - np.median(second)))) / math.sqrt(6.0)


def counts_of(recording: EncoderRecording) -> tuple[float, float]:
    """One count of the motor's encoder and of the load's."""
    given = ((recording.motor_count, recording.motor), (recording.load_count, recording.load))
    motor, load = (resolution(values) if count is None else count for count, values in given)
    return motor, load


def strokes_of(recording: EncoderRecording, least: float) -> Strokes:
    """Cut at reversals of the motor by more than `least` (the motor's unit)."""
    side = np.zeros(recording.motor.size, dtype=np.int8)
    play_and_side(recording.motor, least, side)
    known = np.flatnonzero(side)
    if not known.size:
        return Strokes(np.zeros(1, dtype=int), np.zeros(1, dtype=int))
    changes = known[1:][side[known[1:]] != side[known[:-1]]]
    begin = np.concatenate([[known[0]], changes])
    return Strokes(begin, side[begin].astype(int))
