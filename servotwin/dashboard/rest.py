"""Word on the end of a window: the machine rests, swings down, or goes on swinging (a limit cycle)."""

from __future__ import annotations

import itertools
import math
from array import array
from typing import Any

from servotwin.dashboard.window_view import whole_channel
from servotwin.messages import WindowMessage

REST, LIMIT_CYCLE, SWINGS_DOWN, NOT_SEEN, NOISE = "rest", "limit cycle", "swings down", "not seen", "noise"
_STILL, _KEPT, _LEAST_TURNS, _LEAST_SAMPLES = 0.02, 0.7, 3, 8
"""Half the travel in the last quarter, over the step, that counts as rest; share of the swing of the quarter before
that a limit cycle keeps at least; crossings of the mean without which nothing is told; samples of a quarter."""
_NOISE = 4.0
"""Standard deviations of the noise by which a swing goes beyond the mean on either side. White noise hardly does; a
sine of more than 13 samples a period, whose steps from sample to sample count as noise here, always does."""


def at_rest(message: WindowMessage) -> dict[str, Any]:
    """Tell whether the machine came to rest after the last change of the reference in a window.

    Returns
    -------
    dict
        word; swing (m or rad, half the travel in the last quarter), frequency (Hz; None: no cycle is seen), seconds
        (that were looked at). The word "noise": the noise of the samples may hide a cycle.
    """
    unknown = {"word": NOT_SEEN, "swing": None, "frequency": None, "seconds": 0.0}
    position, reference = (whole_channel(message, name) for name in ("position", "reference"))
    if position is None or reference is None:
        return unknown
    whole = position
    begun = max((time for time, _ in message.reference_changes), default=message.start) - message.start
    position = position[max(0, round(begun * message.rate)) :]
    seconds, quarter = len(position) / message.rate, len(position) // 4
    # Where the window begins with the change, only the error shows how large it was.
    step = max(max(reference) - min(reference), max(map(abs, map(float.__sub__, reference, whole))))
    if quarter < _LEAST_SAMPLES or step <= 0.0:
        return {**unknown, "seconds": seconds}
    before, last = _swing(position[-2 * quarter : -quarter]), _swing(position[-quarter:])
    if last <= _STILL * step:
        return {"word": REST, "swing": last, "frequency": None, "seconds": seconds}
    noise = _NOISE * _noise(position[-2 * quarter :])
    crossings = _crossings(position[-2 * quarter :], noise)
    if crossings < _LEAST_TURNS:
        return {**unknown, "word": NOISE if noise > _STILL * step else NOT_SEEN, "swing": last, "seconds": seconds}
    word = LIMIT_CYCLE if last >= _KEPT * before else SWINGS_DOWN
    return {"word": word, "swing": last, "frequency": crossings * message.rate / (4.0 * quarter), "seconds": seconds}


def _swing(part: array[float]) -> float:
    return 0.5 * (max(part) - min(part))


def _noise(part: array[float]) -> float:
    """Standard deviation of the noise, were it white and all that changes from sample to sample."""
    return math.sqrt(sum((after - before) ** 2 for before, after in itertools.pairwise(part)) / (2.0 * len(part)))


def _crossings(part: array[float], beyond: float) -> int:
    """Crossings of the mean that go beyond it by so much on either side."""
    mean = sum(part) / len(part)
    sides = [value > mean for value in part if abs(value - mean) > beyond]
    return sum(one != other for one, other in itertools.pairwise(sides))
