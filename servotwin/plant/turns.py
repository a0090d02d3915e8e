"""Direction of a reference: the sign of its last change, in continuous time."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from servotwin.plant.signals import Array, PiecewiseCubic


@lru_cache(maxsize=8)
def turns_of(pieces: PiecewiseCubic) -> list[tuple[float, float]]:
    """Times (s), in order, at which a signal begins to change, and the signs of the changes.

    Notes
    -----
    A signal jumps or moves up (1.0) or down (-1.0). Where it rests the last direction holds. A piece that begins to
    move where it jumps has two directions at that time, of which the second holds.
    """
    turns: list[tuple[float, float]] = []
    jumps = {float(time) for time in pieces.jumps}
    ends = np.append(pieces.times[1:], math.inf)
    last = pieces.coeffs[0]
    for k, (time, end, c) in enumerate(zip(pieces.times.tolist(), ends.tolist(), pieces.coeffs, strict=True)):
        if time in jumps:
            elapsed = time - float(pieces.times[k - 1])
            turns.append((time, math.copysign(1.0, c[0] - _value(last, elapsed))))
        turns += [(time + begin, direction) for begin, direction in _ways(c, end - time)]
        last = c
    return turns


def direction_after(pieces: PiecewiseCubic, time: float, before: float, direction: float) -> float:
    """Direction of a signal from a time (s) on, where its value was `before` until then, and its direction so far."""
    piece = max(int(np.searchsorted(pieces.times, time, side="right")) - 1, 0)
    elapsed = time - float(pieces.times[piece])
    ways = [way for begin, way in _ways(pieces.coeffs[piece], math.inf) if begin <= elapsed]
    jumped = float(pieces.value(time)) - before
    moved = math.copysign(1.0, jumped) if jumped else direction
    return ways[-1] if ways else moved


def _value(c: Array, elapsed: float) -> float:
    return float(((c[3] * elapsed + c[2]) * elapsed + c[1]) * elapsed + c[0])


def _ways(c: Array, length: float) -> list[tuple[float, float]]:
    """Times in a cubic of a length (s) from which on it moves one way, and the signs; none where it is constant."""
    if not c[1:].any():
        return []
    roots = np.roots([3.0 * c[3], 2.0 * c[2], c[1]])
    stops = sorted({float(root.real) for root in roots if abs(root.imag) <= 1e-9 * abs(root)})
    begins = [0.0, *(stop for stop in stops if 0.0 < stop < length)]
    # The sign of the slope is that halfway to the next stop: at a stop itself rounding decides on it.
    ends = [*begins[1:], min(length, begins[-1] + 1.0)]
    middles = [0.5 * (begin + end) for begin, end in zip(begins, ends, strict=True)]
    slopes = [(3.0 * c[3] * t + 2.0 * c[2]) * t + c[1] for t in middles]
    return [(begin, math.copysign(1.0, float(slope))) for begin, slope in zip(begins, slopes, strict=True) if slope]
