"""What the motor did in a window: whether it moved, and how often it turned round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotwin.plant.signals import Array

_SPAN_S = 0.02  # speeds are taken over this time: one encoder count between two samples is no motion


@dataclass(frozen=True)
class Motion:
    """Share of the window in which the motor moved (0..1), and how often it changed direction."""

    moving: float
    reversals: int


def motion(theta_m: Array, sample_rate: float, rest_speed: float) -> Motion:
    """Motion of an angle theta_m (n,) rad; slower than `rest_speed` (rad/s) counts as rest."""
    span = min(max(1, round(_SPAN_S * sample_rate)), theta_m.size - 1)
    speed = (theta_m[span:] - theta_m[:-span]) * (sample_rate / span)
    direction = np.sign(speed[np.abs(speed) > rest_speed])
    return Motion(direction.size / speed.size, int(np.count_nonzero(np.diff(direction))))
