"""Recognise an angle that is recorded more often than it was measured: held, or interpolated by straight lines."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.signals import Array

_LARGEST = 20  # factor between the rates
_FEWEST, _SHARE = 5, 0.9  # changes that must show it, and their share of all
# Decades by which chance must be unlikely to put all changes into every n-th sample: any changes, kinks of lines.
_UNLIKELY, _UNLIKELY_KINKS = 9.0, 5.0
# Of the smallest step of the values: no change is below, and rounding makes neither such a step nor such a kink.
_CHANGE, _ROUNDED = 0.5, 2.5
_IN_A_ROW = 4  # values: a repetition
_LINE = 1.0  # of that step: rms of the second differences of a line whose samples were rounded (0.71)
_STRAIGHT = 0.45  # of all samples: those between each second one
_DIGITS = 32 * 1e-13  # of the largest value: smaller steps are rounding of numbers


def upsampled(theta_m: Array, rate: float) -> tuple[str, ...]:
    """Sentence for a motor's angle (N,), recorded at a rate (Hz), that is held or interpolated from a slower one."""
    held = held_factor(theta_m)
    factor = held or line_factor(theta_m)
    if not factor:
        return ()
    how, slow = "held" if held else "interpolated", f"{rate / factor:.6g} Hz"
    return (
        f"theta_m is {how} from a rate about {factor} times slower than the window's: record it at {rate:.6g} Hz, or "
        f"give the window at {slow}, with the samples at which theta_m was measured",
    )


def held_factor(samples: Array) -> int:
    """Factor by which samples were measured more slowly than recorded, each held until the next; 0 where none shows.

    A moving angle that changes by several counts in one sample also changes in the ones beside it. One that is slower
    than its counts changes in any sample, unless it is even: changes at the same distance show nothing.
    """
    step = _smallest_step(samples)
    steps = np.abs(np.diff(samples))
    changes = np.flatnonzero(steps > _CHANGE * step)
    if changes.size < _FEWEST:
        return 0
    distances = np.diff(changes)
    every = int(np.gcd.reduce(distances))
    decades = math.log10(every) * int(np.sum(distances[1:] != distances[:-1]))
    if decades >= _UNLIKELY and decades * _share_of_news(distances) >= _UNLIKELY:
        return every
    leaps = steps[changes] > _ROUNDED * step
    beside = np.pad(distances > 1, 1, constant_values=True)
    alone = beside[:-1] & beside[1:] & leaps
    if np.sum(leaps) < _FEWEST or np.sum(alone) < _SHARE * np.sum(leaps):
        return 0
    return round(float(np.median(np.diff(changes[alone]))))


def line_factor(samples: Array) -> int:
    """Factor by which samples were measured more slowly than recorded, with lines between them; 0 where none shows.

    The second differences of lines vanish, but for rounding, in all samples but every n-th. Those of a moving angle
    come in neighbours: where it changes its counts by one, and where its speed changes.
    """
    step = _smallest_step(samples)
    kinks = np.diff(samples, 2) / (step or 1.0)
    if np.sum(np.abs(kinks) <= _ROUNDED) < _STRAIGHT * kinks.size:
        return 0
    found = (each for each in range(_LARGEST, 1, -1) if _lines_between(kinks, each))
    return next(found, 0)


def _lines_between(kinks: Array, every: int) -> bool:
    """True where second differences, in smallest steps, are those of lines between each n-th sample."""
    rows = kinks.size // every
    if rows < _FEWEST:
        return False
    squares = np.sum(kinks[: rows * every].reshape(rows, every) ** 2, axis=0)
    place = int(np.argmax(squares))
    between = math.sqrt((float(squares.sum()) - float(squares[place])) / (rows * (every - 1)))
    return between <= _LINE and any(_unlikely(kinks, least, place, every) for least in (_CHANGE, _ROUNDED))


def _unlikely(kinks: Array, least: float, place: int, every: int) -> bool:
    """True where those beyond `least` lie in each n-th sample from a place on, and chance hardly puts them there."""
    shown = np.abs(kinks) > least
    there = int(np.sum(shown[place::every]))
    decades = there * math.log10(every)
    if there < max(_FEWEST, _SHARE * int(np.sum(shown))) or decades <= _UNLIKELY_KINKS:
        return False
    news = max(_share_of_news(np.round(kinks[shown])), _share_of_news(np.diff(np.flatnonzero(shown))))
    return decades * news > _UNLIKELY_KINKS


def _share_of_news(values: NDArray[np.generic]) -> float:
    """Share of a sequence that repeats nothing: an even swing may change in the same samples of each period."""
    if values.size <= _IN_A_ROW:
        return 1.0
    rows = np.lib.stride_tricks.sliding_window_view(values, _IN_A_ROW)
    return len(np.unique(rows, axis=0)) / len(rows)


def _smallest_step(samples: Array) -> float:
    """Smallest step between two values, beyond the rounding of numbers; 0 for a constant."""
    steps = np.diff(np.unique(samples))
    steps = steps[steps > _DIGITS * float(np.max(np.abs(samples)))]
    return float(steps.min()) if steps.size else 0.0
