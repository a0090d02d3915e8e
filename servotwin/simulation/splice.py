"""Inputs that become others while a simulation runs."""

from __future__ import annotations

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.plant.signals import PiecewiseCubic


def about(pieces: PiecewiseCubic, time: float) -> Array:
    """(4,) ascending coefficients, about a time (s), of the piece in force there."""
    piece = max(int(np.searchsorted(pieces.times, time, side="right")) - 1, 0)
    shift, c = time - pieces.times[piece], pieces.coeffs[piece]
    return np.array(
        [
            ((c[3] * shift + c[2]) * shift + c[1]) * shift + c[0],
            (3.0 * c[3] * shift + 2.0 * c[2]) * shift + c[1],
            3.0 * c[3] * shift + c[2],
            c[3],
        ]
    )


def spliced(before: PiecewiseCubic, after: PiecewiseCubic, time: float) -> PiecewiseCubic:
    """One signal up to a time (s), another from then on."""
    past, future = before.times < time, after.times > time
    times = np.concatenate([before.times[past], [time], after.times[future]])
    return PiecewiseCubic(times, np.vstack([before.coeffs[past], about(after, time), after.coeffs[future]]))


def recent(pieces: PiecewiseCubic, time: float) -> PiecewiseCubic:
    """The same from a time (s) on; of what was before, only a constant is left."""
    first = int(np.searchsorted(pieces.times, time, side="right")) - 1
    if first <= 0:
        return pieces
    past = [[pieces.coeffs[first, 0], 0.0, 0.0, 0.0]]
    return PiecewiseCubic(np.append(0.0, pieces.times[first:]), np.vstack([past, pieces.coeffs[first:]]))


def shifted(pieces: PiecewiseCubic, offset: PiecewiseCubic) -> PiecewiseCubic:
    """A signal plus another."""
    times = np.union1d(pieces.times, offset.times)
    return PiecewiseCubic(times, [about(pieces, time) + about(offset, time) for time in times.tolist()])
