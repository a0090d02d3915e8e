"""Channels that stay at an extreme value: a limit cuts them, or what they measure has come to rest."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.signals import Array

# Samples at the extreme, at a time (a swing in counts that moves in each sample before has fewer at its crest).
_FLAT, _CREST = 20, 10
RUN, STEEP = 6, 0.05
"""Samples before an instant in which motion is seen; share of the fastest motion that is fast."""
_BRAKED = 18  # samples before an extreme in which a motion may show how hard it brakes


def runs(true: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Begins and ends (k,) of the stretches in which something is true."""
    padded = np.concatenate([[False], true, [False]])
    return np.flatnonzero(padded[1:] & ~padded[:-1]), np.flatnonzero(padded[:-1] & ~padded[1:])


def saturation(name: str, samples: Array, steps: Array, factor: float, unit: str) -> str:
    """Describe samples that stay at an extreme value which was reached at speed; empty without them.

    The crests of an even swing may all be at one count, each for few samples; and what friction stops slows down
    before it, or creeps so slowly that it stops within few samples.
    """
    for extreme in (float(samples.max()), float(samples.min())):
        begins, ends = runs(samples == extreme)
        if (size := int(np.sum(ends - begins))) < _FLAT:
            continue
        run = np.abs(samples[RUN:] - samples[:-RUN])
        fastest = float(np.partition(run, -5)[-5])
        entries = begins[(begins > RUN) & (ends - begins >= _CREST)]
        reached = [entry for entry in entries if np.all(steps[entry - RUN : entry] > 0.0)]
        ways = (
            min(run[entry - RUN], _run_ahead(steps, entry), _way_to_rest(steps, entry), _way_as_before(steps, entry))
            for entry in reached
        )
        if any(way > STEEP * fastest for way in ways):
            value = f"{factor * extreme:.6g} {unit}"
            return f"{name} stays at its extreme of {value} for {size} samples: it is saturated"
    return ""


def _run_ahead(steps: Array, entry: int) -> float:
    """Way of a run of samples at the speed with which a sample is entered.

    By a line through the speeds of the run before it, which leaves out the last step: a limit cuts that.
    """
    earlier, later = np.sum(steps[entry - 1 - RUN : entry - 1].reshape(2, -1), axis=1)
    return float(2.0 * later + (later - earlier) * (RUN // 2 + 2) / (RUN // 2))


def _way_to_rest(steps: Array, entry: int) -> float:
    """Way to rest of what brakes evenly before a sample, as a load does that friction stops; infinite where none does.

    By the three steps before the last one, which a limit cuts.
    """
    first, second, third = steps[entry - 4 : entry - 1]
    if not first > second > third:
        return math.inf
    brake, speed = second - third, max(0.0, 2.0 * third - second)
    return float(0.5 * speed * speed / brake)


def _way_as_before(steps: Array, entry: int) -> float:
    """Way to rest of what brakes before a sample as hard as it did shortly before; infinite where it did not.

    By sums of three steps, without the last one: a load slows down to the speed of its motor, and stops soon after it.
    """
    threes = np.convolve(steps[max(0, entry - 1 - _BRAKED) : entry - 1], np.ones(3), "valid")
    brake = float(np.max(threes[:-3] - threes[3:], initial=0.0)) / 9.0
    speed = float(threes[-1]) / 3.0
    return 0.5 * speed * speed / brake if brake > 0.0 else math.inf
