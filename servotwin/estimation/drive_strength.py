"""Torque of a drive beside the inertia that it moves, as one window shows both, against the stated ones.

From one instant to another the momentum of motor and load changes by the impulse of the drive's torque, less those of
friction and bias, whatever shaft and gap do between the two. While both slide one way, Coulomb friction and bias grow
with the time, and viscous friction with the angle: what is left of the impulse, over what is left of the momentum, says
how much torque a command makes. Nothing is differentiated twice, so that counts of the encoders do little.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.motor_angle import noise_of
from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.late_window import prompt_window
from servotwin.estimation.learning.motor import gaussian_filters
from servotwin.estimation.window import Window
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array

_WIDTHS = (2.5, 4.0, 6.0, 10.0, 16.0, 25.0, 40.0)  # samples: standard deviations of the filter that are tried
_NOISE = 0.005  # of the momentum's range: what noise and counts may leave of it behind the filter
_SLIDES, _SURE = 0.01, 5.0  # of the highest speed; standard deviations of its noise: slower is no sliding
_LONG, _FEWEST = 6.0, 6  # widths of a stretch; rows beyond the unknowns
_DELAYS = np.arange(0.0, 4.01, 0.25)  # samples by which the command may be late
_NEAR_LIMIT = 0.1  # of the drive's limit
# Of the impulse: with more of it unexplained a window does not count; half, where the delay that fits best is none of
# those within the range, but stands for another force.
_UNEXPLAINED = 0.1
_KNOWN = 0.05  # relative standard deviation of a window that counts
# Friction of another kind, and motions that are hardly longer than the filter, moved the strength of 280 windows of
# simulated axes by at most 22 %.
_UNSURE = 0.25


class DriveComparison(NamedTuple):
    """Acceleration per command over the stated one, and whether it may be as stated."""

    strength: float
    agrees: bool

    @property
    def sentence(self) -> str:
        """Sentence for the operator on a drive that is not as stated."""
        return (
            f"the command moves the axis {self.strength:.2g} times as strongly as stated: check the torque per "
            "command, and the inertia of motor and load"
        )


@dataclass(frozen=True)
class DriveStrength:
    """Comparison of windows with the stated torque and inertia of an axis.

    Parameters
    ----------
    axis : Axis
        With a torque drive, and a load of one mass behind a shaft that is free in the gap.
    torque, inertia : float
        Half-widths, relative, of what is stated of them.
    """

    axis: Axis
    torque: float
    inertia: float

    @classmethod
    def of(cls, plant: Plant, torque: float, inertia: float) -> DriveStrength | None:
        """Make it; None for another kind of axis."""
        if not isinstance(plant, Axis) or not isinstance(plant.actuator, TorqueDrive) or plant.n != 1:
            return None
        return cls(plant, torque, inertia) if plant.backlash_kind is BacklashKind.FREE else None

    def compared(self, window: Window) -> DriveComparison | None:
        """Compare a window; None where it does not tell."""
        made = strength(prompt_window(window, self.axis), self.axis)
        if made is None:
            return None
        value, std = made
        stated = math.log((1.0 + self.inertia) / (1.0 - self.torque)) + _UNSURE + NORMAL_95 * std
        return DriveComparison(value, abs(math.log(value)) <= stated)


def strength(window: Window, axis: Axis) -> tuple[float, float] | None:
    """Acceleration per command over the stated one, and its relative standard deviation; None where it does not show.

    Parameters
    ----------
    window : Window
        With the command, each value held until the next sample, and the motor's angle.
    axis : Axis
    """
    if window.voltage is None or window.theta_m is None:
        return None
    found = _stretches(window, axis)
    if found is None:
        return None
    fits = [(delay, fit) for delay in _DELAYS if (fit := _fitted(found, window, axis, float(delay))) is not None]
    if not fits:
        return None
    delay, best = min(fits, key=lambda each: each[1].left)
    allowed = _UNEXPLAINED if _DELAYS[0] < delay < _DELAYS[-1] else 0.5 * _UNEXPLAINED
    if not best.inertia > 0.0 or best.left > allowed or best.std > _KNOWN:
        return None
    return 1.0 / best.inertia, best.std


class _Stretches(NamedTuple):
    """Stretches (first, last) in which motor and load slide one way, momentum (n,) and angle (n,) behind a filter."""

    ends: list[tuple[int, int]]
    momentum: Array
    angle: Array
    kernel: Array
    stride: int


def _stretches(window: Window, axis: Axis) -> _Stretches | None:
    """None where noise hides the momentum, or nothing slides for long."""
    assert isinstance(axis.actuator, TorqueDrive)
    assert window.theta_m is not None
    rate, heavy = window.sample_rate, np.array([axis.actuator.J, axis.p * axis.load.m[0]])
    moved = np.stack([window.theta_m - window.theta_m[0], window.position - window.position[0]])
    counts = np.array([axis.encoder_resolution, axis.sensors.position_resolution]) / math.sqrt(12.0)
    noise = np.maximum(counts, [noise_of(each) for each in moved])
    for width in _WIDTHS:
        filters = gaussian_filters(width)
        if window.samples < filters.shape[1] + _LONG * width:
            return None
        speeds = rate * np.stack([np.convolve(each, filters[1][::-1], "valid") for each in moved])
        momentum, of_speed = heavy @ speeds, rate * float(np.linalg.norm(filters[1])) * noise
        if float(np.linalg.norm(heavy * of_speed)) <= _NOISE * float(np.ptp(momentum)):
            break
    else:
        return None
    least = np.maximum(_SURE * of_speed, _SLIDES * np.abs(speeds).max(axis=1))[:, None]
    ways = np.where(np.abs(speeds) > least, np.sign(speeds), 0.0)
    slides = np.all(ways != 0.0, axis=0) & _followed(window, axis, filters.shape[1])
    ways = np.where(slides, ways, 0.0)
    changes = np.flatnonzero(np.any(np.diff(ways, axis=1) != 0.0, axis=0)) + 1
    begins, lasts = [0, *changes.tolist()], [*changes.tolist(), slides.size]
    ends = [(i, j) for i, j in zip(begins, lasts, strict=True) if slides[i] and j - i >= _LONG * width]
    angle = np.convolve(moved[0], filters[0][::-1], "valid")
    return _Stretches(ends, momentum, angle, filters[0], max(1, round(width))) if ends else None


def _followed(window: Window, axis: Axis, size: int) -> Array:
    """Tell in which stretches of `size` samples the drive follows every command."""
    assert window.voltage is not None
    limit = math.inf if axis.command_limit is None else axis.command_limit
    total = np.concatenate(([0], np.cumsum(np.abs(window.voltage) > (1.0 - _NEAR_LIMIT) * limit)))
    return np.asarray(total[size:] == total[:-size])


class _ImpulseFit(NamedTuple):
    """Inertia over the torque per command, in stated ones, its relative std, and the share that is left."""

    inertia: float
    std: float
    left: float


def _fitted(found: _Stretches, window: Window, axis: Axis, delay: float) -> _ImpulseFit | None:
    """Fit of the impulse of a command that is late by some samples; None where too few rows are left."""
    samples = np.arange(window.samples, dtype=float)
    impulse = np.interp(samples - delay, samples, _impulse(window, axis))
    impulse = np.convolve(impulse, found.kernel[::-1], "valid")
    rows = np.concatenate(list(_bent(found, np.stack([found.momentum, found.angle, impulse], axis=1))))
    free = len(rows) - 2 * len(found.ends) - 3
    size = np.linalg.norm(rows, axis=0)
    if free < _FEWEST or not np.all(size > 0.0):
        return None
    known, target = rows[:, :2] / size[:2], rows[:, 2] / size[2]
    values = np.linalg.lstsq(known, target, rcond=1e-9)[0]
    left = target - known @ values
    power = float(left @ left)
    one = min(0.98, max(0.0, float(left[1:] @ left[:-1]) / power)) if power > 0.0 else 0.0
    variance = np.linalg.pinv(known.T @ known)[0, 0] * power / free * (1.0 + one) / (1.0 - one)
    if values[0] == 0.0:
        return None
    inertia = float(values[0] * size[2] / size[0])
    return _ImpulseFit(inertia, math.sqrt(variance) / abs(float(values[0])), math.sqrt(power))


def _impulse(window: Window, axis: Axis) -> Array:
    """Impulse (N m s) of the commanded torque up to each sample, behind the current loop's lag."""
    # Here, because scipy.signal takes long to import and many processes estimate nothing.
    from scipy.signal import lfilter

    assert isinstance(axis.actuator, TorqueDrive)
    assert window.voltage is not None
    interval, lag = 1.0 / window.sample_rate, axis.actuator.lag
    kept = math.exp(-interval / lag) if lag > 0.0 else 0.0
    first = window.voltage[0]
    torque = axis.actuator.gain * (first + lfilter([1.0 - kept], [1.0, -kept], window.voltage - first))
    return interval * np.concatenate(([0.0], np.cumsum(torque)[:-1]))


def _bent(found: _Stretches, columns: Array) -> Iterator[Array]:
    """Rows (n, k) of each stretch without what is constant or grows with the time."""
    for first, last in found.ends:
        rows = columns[first : last : found.stride]
        straight = np.stack([np.ones(len(rows)), np.linspace(-1.0, 1.0, len(rows))], axis=1)
        yield rows - straight @ np.linalg.lstsq(straight, rows, rcond=None)[0]
