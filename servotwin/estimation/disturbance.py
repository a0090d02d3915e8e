"""Disturbances of a servo at rest: the bias at the motor's input, and the noise of the position.

At rest nothing accelerates, so on average no torque is passed on, and the motor's voltage cancels the bias, whatever
the controller is made of. A motor that creeps across its gap is still at rest in that sense: the voltage then carries
its back EMF too, which is taken off (Eq 4 without acceleration). Coulomb friction holds a motor at rest against any
voltage up to its own and cannot be told from a bias.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.window import Window
from servotwin.plant.actuator import Stepper
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.scales import Scales, scales
from servotwin.plant.signals import Array

# Seconds and volts are the servo's own (`plant.scales`).
SHORTEST = 0.1  # s: shortest rest that counts
_BATCH_S, _GROUPS = 0.025, 8  # s over which samples are averaged; most groups of means that a spread is computed from
_CREEP = 0.1  # V of back EMF: a slower motor counts as at rest
_BACK_EMF_SHARE = 0.1  # relative error of k_B that the spread allows for
_SMOOTH = 1.0  # mean square of successive differences over variance: 2 for noise, 0.2 for a swing at 3 Hz
_FEWEST = 8  # fewest means that tell noise from a swing
_NEAR, _FINE = 2.0, 1e-3  # times the least spread, or V: a longer rest with so little more is preferred
_DRIFTS = 2.0  # standard deviations: a smaller drift counts as chance


@dataclass(frozen=True)
class Disturbance:
    """Input bias and measurement noise, as one window shows them.

    Attributes
    ----------
    bias : float
        V, added to the voltage on its way to the motor; NaN when unknown.
    bias_std : float
        V; inf when unknown.
    noise : float
        m, standard deviation of the measured position about its slow motion at rest; NaN when unknown.
    rest : float
        s, length of the rest that this stands on; 0 without one.
    effort : float
        V, root mean square of the voltage in the whole window; NaN when it was not recorded.
    reasons : tuple of str
        Reasons for unknown values, one sentence each.
    """

    bias: float
    bias_std: float
    noise: float
    rest: float
    effort: float
    reasons: tuple[str, ...] = ()

    @property
    def known(self) -> bool:
        """True where the bias is known."""
        return math.isfinite(self.bias)


def nothing_known(effort: float, *reasons: str) -> Disturbance:
    """Return the result for a window without a rest; `effort` in V."""
    return Disturbance(math.nan, math.inf, math.nan, 0.0, effort, reasons)


def disturbance(window: Window, servo: Plant) -> Disturbance:
    """Estimate input bias and noise from the longest rest whose spread is close to the least.

    Parameters
    ----------
    window : Window
        With reference, voltage and theta_m; the voltage as commanded, feedforward included, bias not.
    servo : Servo or Axis
        For its back EMF, its pitch, and the limit of its drive.
    """
    window = window.driven(servo.command_limit)
    effort = math.nan if window.voltage is None else float(np.sqrt(np.mean(window.voltage**2)))
    if holds_position(servo):
        return nothing_known(effort, "a stepper holds its position: its command at rest is no bias")
    missing = [name for name in ("reference", "voltage", "theta_m") if name not in window.channels]
    if missing:
        return nothing_known(effort, f"the window has no {' and no '.join(missing)}")
    units = scales(servo)
    size, shortest = _sizes(window, units)
    stretches = [
        (last - count * size, last)
        for first, last in _constant(window)
        for count in range(shortest, (last - first) // size + 1)
    ]
    rests = list(_rests(window, servo, size, stretches))
    if not rests:
        return nothing_known(effort, _no_rest(bool(stretches), SHORTEST * units.time))
    bias, std, first, last = _longest_good(rests, _FINE * units.voltage)
    noise = _noise(window.position[first:last], size)
    return Disturbance(bias, std, noise, (last - first) / window.sample_rate, effort)


def holds_position(servo: Plant) -> bool:
    """True for a motor whose command is its position."""
    return isinstance(servo, Axis) and isinstance(servo.actuator, Stepper)


def quick_bias(window: Window, servo: Plant) -> tuple[float, float]:
    """Estimate input bias and spread (V) from the last `SHORTEST` s before a reference change or the window's end.

    The first such interval at rest counts; without one, or without the channels, the result is (NaN, inf).
    """
    if holds_position(servo) or not {"reference", "voltage", "theta_m"} <= window.channels.keys():
        return math.nan, math.inf
    window = window.driven(servo.command_limit)
    size, least = _sizes(window, scales(servo))
    shortest = [(last - least * size, last) for first, last in _constant(window) if last - first >= least * size]
    bias, std, _, _ = next(_rests(window, servo, size, shortest), (math.nan, math.inf, 0, 0))
    return bias, std


def _sizes(window: Window, units: Scales) -> tuple[int, int]:
    """Samples of a batch, and batches of the shortest rest."""
    rate = window.sample_rate * units.time
    size = max(1, round(_BATCH_S * rate))
    return size, max(4, math.ceil(SHORTEST * rate / size - 1e-9))


def _longest_good(rests: list[tuple[float, float, int, int]], fine: float) -> tuple[float, float, int, int]:
    """Select the longest of (bias, std, first, last) with little more than the least spread, which is partly chance."""
    allowed = max(_NEAR * min(rest[1] for rest in rests), fine)
    return max((rest for rest in rests if rest[1] <= allowed), key=lambda rest: rest[3] - rest[2])


def _constant(window: Window) -> list[tuple[int, int]]:
    """(first, last) of every stretch with a constant reference."""
    assert window.reference is not None
    reference = window.reference
    changes = (np.flatnonzero(reference[1:] != reference[:-1]) + 1).tolist()
    return list(pairwise([0, *changes, reference.size]))


def _rests(
    window: Window, servo: Plant, size: int, stretches: Sequence[tuple[int, int]]
) -> Iterator[tuple[float, float, int, int]]:
    """Yield (bias, std, first, last) of the stretches in which nothing moves."""
    begins: dict[int, int] = {}
    for first, last in stretches:
        begins[last] = min(first, begins.get(last, first))
    per_sample, creep = servo.command_per_speed * window.sample_rate, _CREEP * scales(servo).voltage
    steep = per_sample / creep, per_sample / creep / servo.p
    batches: dict[int, _Batches] = {}
    for first, last in stretches:
        if last not in batches:
            batches[last] = _batches(window, size, begins[last], last, per_sample)
        rest = _rest(steep, size, (last - first) // size, batches[last])
        if rest is not None:
            yield *rest, first, last


class _Means(NamedTuple):
    """Means of batches (n,), the squares of their differences, and the largest difference of the last 2, 3 .. n."""

    values: Array
    squares: Array
    largest: Array

    @classmethod
    def of(cls, samples: Array, size: int) -> _Means:
        values = _means(samples, size)
        steps = values[1:] - values[:-1]
        return cls(values, steps**2, np.maximum.accumulate(np.abs(steps)[::-1]))


class _Batches(NamedTuple):
    """Batches that end with a constant reference: means, and of each the motor's back EMF and the rest of its voltage
    (V)."""

    angle: _Means
    position: _Means
    back_emf: Array
    drive: Array


def _batches(window: Window, size: int, first: int, last: int, per_sample: float) -> _Batches:
    """`per_sample`: V of one radian per sample."""
    assert window.voltage is not None
    assert window.theta_m is not None
    angle = window.theta_m[first:last]
    ends = np.append(angle[::size], angle[-1] + (angle[-1] - angle[-2]))
    back_emf = per_sample * (ends[1:] - ends[:-1]) / size
    drive = _means(window.voltage[first:last], size) - back_emf
    return _Batches(_Means.of(angle, size), _Means.of(window.position[first:last], size), back_emf, drive)


def _rest(steep: tuple[float, float], size: int, count: int, batches: _Batches) -> tuple[float, float] | None:
    """(bias, std) of the last `count` batches; None where something moves in them. `steep`: as of `_still`, for motor
    and load."""
    if not (_still(batches.angle, count, size, steep[0]) and _still(batches.position, count, size, steep[1])):
        return None
    drive = batches.drive[-count:]
    wrong = _BACK_EMF_SHARE * abs(float(np.mean(batches.back_emf[-count:])))
    return -float(np.mean(drive)), math.hypot(_spread(drive), wrong)


def _still(means: _Means, count: int, size: int, steep: float) -> bool:
    """Tell whether a signal rests in its last `count` batches but for noise; one unit per sample is `steep` times what
    counts as rest."""
    if steep * float(means.largest[count - 2]) / size <= 1.0:
        return True
    return count >= _FEWEST and _roughness(means.values[-count:], means.squares[1 - count :]) >= _SMOOTH


def _roughness(means: Array, squares: Array) -> float:
    """Mean square of successive differences, given their squares, over the variance (von Neumann's ratio)."""
    left = means - float(np.add.reduce(means)) / means.size
    variance = float(np.add.reduce(left * left)) / means.size
    return float(np.add.reduce(squares)) / squares.size / variance if variance > 0.0 else math.inf


def _spread(drive: Array) -> float:
    """Standard deviation of the mean of correlated values, from the means of groups; a clear drift adds half of it."""
    count = min(_GROUPS, drive.size)
    bounds = np.arange(count + 1) * drive.size // count
    groups = np.add.reduceat(drive, bounds[:-1]) / np.diff(bounds)
    line = np.arange(count) - 0.5 * (count - 1)
    slope = float(line @ groups) / float(line @ line)
    left = groups - groups.mean() - slope * line
    by_chance = math.sqrt(float(left @ left) / (count - 2) * 12.0 / (count * (count * count - 1.0)))
    drift = 0.5 * abs(slope) * (count - 1) if abs(slope) > _DRIFTS * by_chance else 0.0
    return math.hypot(_few(count - 2) * math.sqrt(float(left @ left) / (count - 2) / count), drift)


@lru_cache(maxsize=16)
def _few(freedom: int) -> float:
    """Return the factor from normal to Student's 95 % interval, for a spread estimated from few values."""
    # Here, because scipy.special takes long to import and many processes estimate nothing.
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975)) / NORMAL_95


def _noise(position: Array, size: int) -> float:
    """rms (m) about the slow motion: a straight line, or, where that leaves a smooth curve, the course of the means."""
    count = position.size
    line = np.arange(count) - 0.5 * (count - 1)
    left = position - position.mean() - line * float(line @ position) / float(line @ line)
    means = _Means.of(left, size)
    if _roughness(means.values, means.squares) < _SMOOTH:
        middles = (np.arange(means.values.size) + 0.5) * size - 0.5
        left = left - np.interp(np.arange(count), middles, means.values)
    return float(np.sqrt(left @ left / (count - 2)))


def _means(samples: Array, size: int) -> Array:
    return np.asarray(np.add.reduce(samples.reshape(-1, size), axis=1) / size)


def _no_rest(constant: bool, shortest: float) -> str:
    if not constant:
        return f"the reference is nowhere constant for {shortest:g} s"
    return f"motor and position rest nowhere for {shortest:g} s while the reference is constant"
