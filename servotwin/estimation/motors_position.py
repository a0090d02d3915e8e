"""Recognition of a window's position that the drive computed from the motor's angle."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from servotwin.estimation.core.visible import counted
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array

# Samples by which the two are apart, read one after the other, held or smoothed; share by which the ratio is off.
_APART, _RATIO = 5, 0.01


def is_motors_position(window: Window, plant: Plant) -> bool:
    """True where a window's position is the motor's own, of an axis whose controller reads the motor's encoder.

    Behind a rigid transmission it may be late, held or smoothed by up to five samples, and rounded: it then lies
    between the least and the greatest of the motor's angles about each sample. A load behind a gap does not, because it
    rests where it came to rest. So a position that does is the motor's own, or the load's without a gap.
    """
    if not isinstance(plant, Axis) or not plant.at_motor or window.measured_position is None:
        return False
    rounded = plant.p * plant.encoder_resolution
    if window.follows_motor(plant.p, within=rounded):
        return True
    angle, position = window.theta_m, window.measured_position
    if not plant.rigid or angle is None or np.ptp(angle) == 0.0 or window.samples <= 2 * _APART:
        return False
    # A late position has not quite the ratio of the least squares.
    centred = angle - angle.mean()
    shown = float(centred @ position / (centred @ centred))
    ratios = [plant.p, shown] if abs(shown / plant.p - 1.0) <= _RATIO else [plant.p]
    return any(_beyond(ratio * angle, position) <= rounded + counted(position) for ratio in ratios)


def _beyond(motor: Array, position: Array) -> float:
    """Excess of a position, but for a constant, over the samples of the motor's about it."""
    low, high = _about_each_sample(motor)
    inner = position[_APART:-_APART]
    return float(np.max(inner - high) - np.min(inner - low))


def _about_each_sample(values: Array) -> tuple[Array, Array]:
    """Least and greatest of the samples up to `_APART` away from each one that has as many on both sides."""
    near = sliding_window_view(values, 2 * _APART + 1)
    return near.min(axis=1), near.max(axis=1)
