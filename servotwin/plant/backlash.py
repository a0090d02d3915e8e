"""The gap of the lead screw as a play operator: the screw rests until the motor's side of the gap pushes it.

theta_d is clamped to [theta_m - b, theta_m + b], b half the TOTAL gap. This is Eqs 16-18 read as the results need them:
theta_b there is the total gap (errata E2, E3 and E4): nothing jumps at a reversal, a growing gap
never moves the screw, and a shrinking one pushes it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from servotwin.errors import InvalidInput
from servotwin.hybrid.compiled import compiled
from servotwin.plant.signals import Array


@compiled
def play_step(theta_d: float, theta_m: float, half_gap: float) -> float:
    """The screw's next angle (rad) for the motor's next angle: the clamp of theta_d to theta_m -+ half_gap."""
    return min(max(theta_d, theta_m - half_gap), theta_m + half_gap)


@compiled
def play_samples(theta_m: Array, half_gap: Array, theta_d0: float) -> Array:
    """As `play`, unchecked and with half gaps: (n,) and either (n,) or (1,) arrays."""
    theta_d = np.empty_like(theta_m)
    now = theta_d0
    stride = 0 if half_gap.size == 1 else 1
    for i in range(theta_m.size):
        now = play_step(now, theta_m[i], half_gap[i * stride])
        theta_d[i] = now
    return theta_d


def play(theta_m: ArrayLike, gap: ArrayLike, theta_d0: float = 0.0) -> Array:
    """Angle of the screw behind a gap, sample by sample (Eqs 16-18 as a clamp).

    Exact for motor angles that are monotone between samples, with a gap that is too.

    Parameters
    ----------
    theta_m : (n,) array
        rad, angle of the motor.
    gap : float or (n,) array
        rad, TOTAL gap.
    theta_d0 : float
        rad, angle of the screw before the first sample; clamped into the gap there.

    Returns
    -------
    (n,) array
        rad, angle of the screw.

    Raises
    ------
    InvalidInput
        Shapes differ, a number is not finite, or the gap is negative somewhere.
    """
    angles = np.ascontiguousarray(theta_m, dtype=float)
    half = 0.5 * np.atleast_1d(np.ascontiguousarray(gap, dtype=float))
    if angles.ndim != 1 or half.shape not in ((1,), angles.shape):
        raise InvalidInput(
            f"play needs theta_m (n,) and a gap that is a number or (n,), not {angles.shape} and {half.shape}"
        )
    if not (np.all(np.isfinite(angles)) and np.all(np.isfinite(half)) and np.isfinite(theta_d0)):
        raise InvalidInput("play: theta_m, gap and theta_d0 must be finite, in rad")
    if np.any(half < 0.0):
        first = int(np.argmax(half < 0.0))
        raise InvalidInput(f"gap = {2.0 * half[first]:.6g} rad at sample {first} is negative; it must be 0 rad or more")
    return play_samples(angles, half, float(theta_d0))
