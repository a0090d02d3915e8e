"""Static lost motion: how far the motor's angle and the position disagree where everything rests."""

from __future__ import annotations

import numpy as np

from servotwin.plant.signals import Array

_BLOCK_S = 0.1
_STILL = 0.02  # of the gap: what moves less within a block rests


def static_lost_motion(theta_m: Array, position: Array, rate: float, static_gain: float, gap: float) -> float:
    """Range (rad) of theta_m - position / static gain over the blocks in which both rest; it cannot exceed the gap.

    Parameters
    ----------
    theta_m, position : (n,) arrays
        rad, m.
    rate : float
        Hz.
    static_gain : float
        m/rad.
    gap : float
        rad, the fitted one: rest means motion below a fiftieth of it.
    """
    size = max(4, round(_BLOCK_S * rate))
    count = theta_m.size // size
    angle = theta_m[: count * size].reshape(count, size)
    load = position[: count * size].reshape(count, size) / static_gain
    allowed = _STILL * gap
    still = (np.ptp(angle, axis=1) < allowed) & (np.ptp(load, axis=1) < allowed)
    lead = (angle - load).mean(axis=1)[still]
    return float(np.ptp(lead)) if lead.size > 1 else 0.0
