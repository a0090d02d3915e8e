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
    stretches = _constant(window, size, shortest)
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
    if holds_position(servo) or any(name not in window.channels for name in ("reference", "voltage", "theta_m")):
        return math.nan, math.inf
    window = window.driven(servo.command_limit)
    size, least = _sizes(window, scales(servo))
    ends = {last: first for first, last in reversed(_constant(window, size, least))}
    shortest = [(first, last) for last, first in reversed(ends.items())]
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


def _constant(window: Window, size: int, shortest: int) -> list[tuple[int, int]]:
    """(first, last) of every stretch of whole batches that ends with a constant reference, and is long enough."""
    assert window.reference is not None
    edges = [0, *(np.flatnonzero(np.diff(window.reference)) + 1), window.reference.size]
    pairs = pairwise(edges)
    return [(int(b) - k * size, int(b)) for a, b in pairs for k in range(shortest, (b - a) // size + 1)]


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
            batches[last] = _batches(window, size, begins[last], last)
        rest = _rest(per_sample, steep, size, (last - first) // size, batches[last])
        if rest is not None:
            yield *rest, first, last


class _Batches(NamedTuple):
    """Means of batches that end with a constant reference, and the motor's angle at the ends of each (rad)."""

    angle: Array
    position: Array
    voltage: Array
    ends: Array


def _batches(window: Window, size: int, first: int, last: int) -> _Batches:
    assert window.voltage is not None
    assert window.theta_m is not None
    angle = window.theta_m[first:last]
    position, voltage = _means(window.position[first:last], size), _means(window.voltage[first:last], size)
    ends = np.append(angle[::size], angle[-1] + (angle[-1] - angle[-2]))
    return _Batches(_means(angle, size), position, voltage, ends)


def _rest(
    per_sample: float, steep: tuple[float, float], size: int, count: int, batches: _Batches
) -> tuple[float, float] | None:
    """(bias, std) of the last `count` batches; None where something moves in them.

    Parameters
    ----------
    per_sample : float
        V of one radian per sample.
    steep : (float, float)
        For motor and load, as of `_still`.
    """
    if not (_still(batches.angle[-count:], size, steep[0]) and _still(batches.position[-count:], size, steep[1])):
        return None
    speed = per_sample * np.diff(batches.ends[-count - 1 :]) / size
    drive = batches.voltage[-count:] - speed
    wrong = _BACK_EMF_SHARE * abs(float(np.mean(speed)))
    return -float(np.mean(drive)), math.hypot(_spread(drive), wrong)


def _still(means: Array, size: int, steep: float) -> bool:
    """Tell whether a signal rests but for noise; one unit per sample is `steep` times what counts as rest."""
    if steep * float(np.max(np.abs(np.diff(means)))) / size <= 1.0:
        return True
    return means.size >= _FEWEST and _roughness(means) >= _SMOOTH


def _roughness(means: Array) -> float:
    """Mean square of successive differences over the variance (von Neumann's ratio)."""
    variance = float(np.var(means))
    return float(np.mean(np.diff(means) ** 2)) / variance if variance > 0.0 else math.inf


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
    means = _means(left, size)
    if _roughness(means) < _SMOOTH:
        left = left - np.interp(np.arange(count), (np.arange(means.size) + 0.5) * size - 0.5, means)
    return float(np.sqrt(left @ left / (count - 2)))


def _means(samples: Array, size: int) -> Array:
    return np.asarray(samples.reshape(-1, size).mean(axis=1))


def _no_rest(constant: bool, shortest: float) -> str:
    if not constant:
        return f"the reference is nowhere constant for {shortest:g} s"
    return f"motor and position rest nowhere for {shortest:g} s while the reference is constant"
