"""Sample rate that shows how a motor swings against its load through a shaft that is free in the gap.

Between two samples the motor's angle is a cubic. Where a flank throws the motor back within few samples, the cubic is
wrong, and with it the force that moves the load.
"""

from __future__ import annotations

import math

from servotwin.plant.actuator import DcMotor, TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant

# In a period of that swing: with fewer, random axes had accepted gaps outside of their intervals
# (docs/estimator-axes.md).
_SAMPLES = 7.0


def least_rate(plant: Plant) -> float:
    """Hz, the least sample rate of a window of a plant; 0.0 where its motor does not yield to the load."""
    if not isinstance(plant, Axis) or plant.backlash_kind is not BacklashKind.FREE:
        return 0.0
    if not isinstance(plant.actuator, DcMotor | TorqueDrive):
        return 0.0
    return _SAMPLES * _swing(plant, plant.actuator.J)


def too_slow(plant: Plant, rate: float) -> str:
    """Sentence for a sample rate (Hz) that is too low; empty where it is enough."""
    least = least_rate(plant)
    if rate >= least * (1.0 - 1e-9):
        return ""
    return (
        f"{rate:.4g} Hz are too few samples: motor and load swing against each other at {least / _SAMPLES:.4g} Hz, "
        f"and {_SAMPLES:g} samples a period, {least:.4g} Hz, are needed"
    )


def _swing(axis: Axis, inertia: float) -> float:
    """Hz, of the motor against the whole load on the shaft, without damping."""
    return math.sqrt(axis.transmission.k_d * (axis.p**2 / inertia + 1.0 / sum(axis.load.m))) / (2.0 * math.pi)
