"""The motor's own numbers, learnt across windows: back EMF, lag, friction and input bias.

From its voltage to its angle a motor with a rigid screw obeys, whatever the structure and the gap do (Eqs 4, 7):
voltage = k_B speed + lag (acceleration + jerk L/R) + friction sign(speed) - bias, with lag = J R / k_T. All of these
numbers enter linearly. Voltage and angle pass the same smooth filter, whose derivatives are those of the motion, so
that nothing is differenced; a voltage that is held between samples is filtered exactly.

A window in which the motor turns one way tells friction and bias only together; the next one, the other way, tells them
apart. So they are learnt with their covariance, in one Kalman filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.window import Window
from servotwin.plant.scales import scales
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

BACK_EMF, LAG, FRICTION, BIAS = range(4)
_WIDTH_S, _WIDTH_SAMPLES = 5e-3, 2.5  # standard deviation of the filter: on the paper's servo, and at least
_REACH = 7.0  # standard deviations at which the filter ends: less would leave a share of the angle's offset
_SPACING = 3.0  # standard deviations between two rows, whose noise is then independent (correlation 0.1)
_MOVING = 0.02  # of the highest speed in the window: below it the friction is not that of sliding
_ABOVE_NOISE = 20.0  # standard deviations of the speed's noise: slower motion would bias the back EMF
_FEWEST = 8  # rows
_MOST_UNEXPLAINED = 0.1  # of the voltage: with more of it unexplained the window is not of this motor
_EXACT = 1e-3  # of the voltage: no model is more exact than that
_CONTRADICTED, _ANEW = 1, 2  # what was said
_WIDE = 10.0  # times the window's voltage: nothing is known of friction and bias before the first window
_NEAR_LIMIT = 0.1  # of the drive's limit: the input bias may take a command that is so close to it beyond it
_SURPRISE = 5.0  # standard deviations, of a window's back EMF and lag from what was learnt
_BIAS_DRIFT, _FRICTION_DRIFT = 1e-3, 0.1  # V/sqrt(s) on the paper's servo: random walk of the bias; over it, friction's
_DAY_S = 86400.0


class LearntMotor(Struct, frozen=True):
    """Knowledge of a motor after some windows.

    Attributes
    ----------
    mean : tuple of 4 float
        Back EMF and lag, relative to the model's and less one; friction and input bias, V.
    covariance : tuple of 16 float
        Row by row.
    time : float
        s, on the twin's clock, of the last window that counted.
    windows : int
        Windows that counted.
    surprises : int
        Windows in a row since then that contradict it.
    alarm : str
        Sentence on a motor that is not what was learnt; empty without one.
    said : int
        What was said since a window last fitted: 1: that one contradicts it; 2: that it is learnt anew.
    """

    mean: tuple[float, ...]
    covariance: tuple[float, ...]
    time: float
    windows: int = 1
    surprises: int = 0
    alarm: str = ""
    said: int = 0

    @property
    def matrix(self) -> Array:
        """(4, 4) covariance."""
        return np.array(self.covariance).reshape(4, 4)

    def std(self, index: int) -> float:
        """Standard deviation of one of the four numbers."""
        return math.sqrt(self.covariance[5 * index])

    def surely(self, index: int) -> float:
        """Least distance of one of the four numbers from the model's, at 95 %."""
        return max(0.0, abs(self.mean[index]) - NORMAL_95 * self.std(index))

    @property
    def friction(self) -> tuple[float, float]:
        """95 % interval of the friction, V, cut at 0."""
        middle, half = self.mean[FRICTION], NORMAL_95 * self.std(FRICTION)
        return max(0.0, middle - half), max(0.0, middle + half)

    def predicted(self, walks: Array, now: float) -> tuple[Array, Array]:
        """Mean and covariance at a time (s), after random walks of (4,) variances per second."""
        return np.array(self.mean), self.matrix + np.diag(walks * max(0.0, now - self.time))

    def words(self) -> str:
        """The numbers with the half-widths of their 95 % intervals."""
        shown = (("back EMF", 100.0, " %"), ("lag", 100.0, " %"), ("friction", 1.0, " V"), ("input bias", 1.0, " V"))
        parts = zip(shown, self.mean, range(4), strict=True)
        return ", ".join(
            f"{name} {scale * value:+.3g} ± {scale * NORMAL_95 * self.std(index):.2g}{unit}"
            for (name, scale, unit), value, index in parts
        )


class MotorRows(NamedTuple):
    """Linear equations of the motor's numbers: voltage (n,) = design (n, 4) numbers + noise."""

    voltage: Array
    design: Array


def motor_rows(window: Window, servo: Servo, limit: float | None = None) -> MotorRows | None:
    """Make the equations that a window gives; None where it has too few, or no voltage or angle.

    Parameters
    ----------
    window : Window
        With the commanded voltage, each value held until the next sample, and the motor's angle.
    servo : Servo
        The model; its screw must be rigid, or the load acts back on the motor.
    limit : float, optional
        V, largest command that the drive follows; rows that reach close to it do not count. None: any.
    """
    if window.voltage is None or window.theta_m is None or not servo.rigid:
        return None
    interval = 1.0 / window.sample_rate
    width = max(_WIDTH_S * scales(servo).time, _WIDTH_SAMPLES * interval) / interval
    filters = gaussian_filters(width)
    size, stride = filters.shape[1], max(1, round(_SPACING * width))
    if window.position.size < size + stride * _FEWEST:
        return None
    angle = np.lib.stride_tricks.sliding_window_view(window.theta_m - window.theta_m[0], size)
    volts = np.lib.stride_tricks.sliding_window_view(window.voltage, size)[::stride] @ filters[0]
    # The speed at every sample, because a reversal anywhere in a filter's reach spoils its friction.
    speed = np.convolve(window.theta_m - window.theta_m[0], filters[1][::-1], mode="valid") / interval
    sliding = _sliding(speed, math.ceil(_REACH * width), _least_speed(window, servo, speed, filters[1]))[::stride]
    counts = np.logical_and(sliding, _followed(window.voltage, limit, size)[::stride])
    acceleration, jerk = (angle[::stride] @ filters[k] / interval**k for k in (2, 3))
    lag = servo.J * servo.R / servo.k_T
    design = np.column_stack(
        [
            servo.k_B * speed[::stride],
            lag * (acceleration + servo.L / servo.R * jerk),
            np.sign(speed[::stride]),
            np.full(volts.size, -1.0),
        ]
    )
    if int(np.sum(counts)) < _FEWEST:
        return None
    return MotorRows(volts[counts], design[counts])


@dataclass(frozen=True)
class MotorLearning:
    """Learning of a motor's numbers from its windows.

    Parameters
    ----------
    servo : Servo
        The model.
    settings : LearningSettings
    back_emf, lag : float
        Relative standard deviations of the model's numbers before any window.
    limit : float, optional
        V, largest command that the drive follows; windows hold commands. None: any.
    """

    servo: Servo
    settings: LearningSettings
    back_emf: float
    lag: float
    limit: float | None = None

    def updated(self, before: LearntMotor | None, window: Window, now: float) -> LearntMotor | None:
        """Update what is known of the motor by a window.

        Parameters
        ----------
        before : LearntMotor, optional
            None: no window has counted yet.
        window : Window
        now : float
            s, on the twin's clock.

        Returns
        -------
        LearntMotor or None
            `before` where the window tells nothing of the motor.
        """
        rows = motor_rows(window, self.servo, self.limit)
        if rows is None:
            return before
        delay = _delay_as_lag(self.servo, window.sample_rate)
        mean, covariance = self._nameplate(rows, delay) if before is None else before.predicted(self._walks, now)
        made = _posterior(rows, mean, covariance)
        if made is None:
            return before
        least = self.settings.motor_floor
        floor = np.array([least, math.hypot(least, delay), 0.0, 0.0])
        short = np.diag(np.maximum(0.0, floor**2 - np.diag(made[1])))
        fresh = LearntMotor(tuple(made[0].tolist()), tuple((made[1] + short).ravel().tolist()), now)
        if before is None:
            return replace(fresh, alarm=self._outside(None, fresh, window))
        if not _surprising(mean, covariance, *made):
            return replace(fresh, windows=before.windows + 1, alarm=self._outside(before, fresh, window))
        return self._contradicted(before, fresh, window, now)

    def lost_at_limit(self, window: Window) -> float:
        """Share of a window's commands at the drive's limit where they leave too little to learn from; 0: they do not.

        A window that would tell nothing without the limit either, such as a short one, is none of these.
        """
        if self.limit is None or window.voltage is None:
            return 0.0
        share = float(np.mean(np.abs(window.voltage) > (1.0 - _NEAR_LIMIT) * self.limit))
        cut = share > 0.0 and motor_rows(window, self.servo, self.limit) is None
        return share if cut and motor_rows(window, self.servo) is not None else 0.0

    def current(self, motor: LearntMotor | None, now: float) -> LearntMotor | None:
        """Return what is known of the motor at a time (s); None where the last windows contradict it."""
        if motor is None or motor.surprises > 0:
            return None
        _, covariance = motor.predicted(self._walks, now)
        return replace(motor, covariance=tuple(covariance.ravel().tolist()), time=max(now, motor.time))

    def _contradicted(self, before: LearntMotor, fresh: LearntMotor, window: Window, now: float) -> LearntMotor | None:
        """Keep what was learnt, with an alarm; some such windows in a row mean another motor.

        Said once until a window fits: where every window is another, what was learnt anew is soon contradicted too.
        """
        count, said = before.surprises + 1, before.said
        alarm = f"the motor is not the one that was learnt: {fresh.words()}, where {before.words()} was learnt"
        if count < self.settings.restart_after:
            return replace(before, surprises=count, alarm="" if said else alarm, said=max(said, _CONTRADICTED))
        anew = self.updated(None, window, now)
        alarm = "" if said == _ANEW else f"{alarm}; it is learnt anew after {count} such windows"
        return anew and replace(anew, alarm=alarm, said=_ANEW)

    def _outside(self, before: LearntMotor | None, after: LearntMotor, window: Window) -> str:
        """Sentence on a number that has turned out to be outside of what is stated of it; empty without one."""
        for name, index, std in (("back EMF k_B", BACK_EMF, self.back_emf), ("lag J R / k_T", LAG, self.lag)):
            stated, off = math.sqrt(3.0) * std, after.surely(index)
            if off > stated and (before is None or before.surely(index) <= stated):
                return (
                    f"the motor is not what is stated: its {name} is at least {100.0 * off:.3g} % off the model's, and "
                    f"{100.0 * stated:.3g} % are stated{self._as_delay(after, window) if index == LAG else ''}; "
                    "check the nameplate, and the motor's load"
                )
        return ""

    def _as_delay(self, motor: LearntMotor, window: Window) -> str:
        """The delay of the voltage that looks like a lag that is larger than the model's; empty: it is smaller."""
        if motor.mean[LAG] <= 0.0:
            return ""
        samples = motor.mean[LAG] / (math.sqrt(12.0) * _delay_as_lag(self.servo, window.sample_rate))
        return f", or the voltage reaches the motor about {samples:.2g} samples late"

    def _nameplate(self, rows: MotorRows, delay: float) -> tuple[Array, Array]:
        wide = _WIDE * float(np.sqrt(np.mean(rows.voltage**2)))
        return np.zeros(4), np.diag(np.square([self.back_emf, math.hypot(self.lag, delay), wide, wide]))

    @property
    def _walks(self) -> Array:
        """(4,) variances per second."""
        unit = scales(self.servo)
        bias = _BIAS_DRIFT * unit.voltage / math.sqrt(unit.time)
        relative = self.settings.motor_drift / math.sqrt(_DAY_S)
        return np.square([relative, relative, _FRICTION_DRIFT * bias, bias])


def _delay_as_lag(servo: Servo, rate: float) -> float:
    """Standard deviation of the lag, relative, when a sample's delay of the voltage is not known: both look alike."""
    return servo.k_B * servo.k_T / (servo.J * servo.R) / (rate * math.sqrt(12.0))


def _posterior(rows: MotorRows, mean: Array, covariance: Array) -> tuple[Array, Array] | None:
    """Mean and covariance after a window; None where the motor's equation does not hold in it."""
    ones = np.array([1.0, 1.0, 0.0, 0.0])
    remainder = rows.voltage - rows.design @ (ones + mean)
    size = float(np.sqrt(np.mean(rows.voltage**2)))
    if size == 0.0:
        return None
    # In units of the prior's spreads, which differ by orders of magnitude.
    spread = np.sqrt(np.diag(covariance))
    precision = np.linalg.inv(covariance / np.outer(spread, spread))
    scaled = rows.design * spread
    # The residual of a fit without the prior, as a wrong prior must not look like noise.
    free = remainder - scaled @ np.linalg.lstsq(scaled, remainder, rcond=None)[0]
    noise = float(np.sqrt(free @ free / max(1, free.size - 4)))
    if noise > _MOST_UNEXPLAINED * size:
        return None
    variance = max(noise, _EXACT * size) ** 2 * _correlated(free)
    after = np.linalg.inv(precision + scaled.T @ scaled / variance)
    moved = spread * (after @ (scaled.T @ remainder)) / variance
    covariance = after * np.outer(spread, spread)
    return mean + moved, 0.5 * (covariance + covariance.T)


def _correlated(residual: Array) -> float:
    """Factor on the variance of a mean whose noise is correlated from row to row (first order)."""
    power = float(residual @ residual)
    if power == 0.0:
        return 1.0
    one = min(0.9, max(0.0, float(residual[1:] @ residual[:-1]) / power))
    return (1.0 + one) / (1.0 - one)


def _surprising(mean: Array, covariance: Array, after: Array, narrowed: Array) -> bool:
    """Tell whether a window moved back EMF and lag further than what was known of them allows."""
    which = slice(BACK_EMF, LAG + 1)
    moved, spread = (after - mean)[which], np.sqrt(np.diag(covariance)[which])
    shrunk = (covariance - narrowed)[which, which] / np.outer(spread, spread)
    values, vectors = np.linalg.eigh(shrunk)
    informative = values > 1e-2
    return float(np.sum(np.square(vectors[:, informative].T @ (moved / spread)) / values[informative])) > _SURPRISE**2


def _sliding(speed: Array, reach: int, least: float) -> Array:
    """Tell at which samples the motor slides one way, and fast enough, within `reach` samples either way."""
    ways = np.where(np.abs(speed) > least, np.sign(speed), 0.0)
    changes = np.cumsum(np.append(1.0, ways[1:] != ways[:-1]))
    places = np.arange(speed.size)
    first, last = np.maximum(places - reach, 0), np.minimum(places + reach, speed.size - 1)
    return np.asarray((ways != 0.0) & (changes[first] == changes[last]))


def _followed(voltage: Array, limit: float | None, size: int) -> Array:
    """Tell in which stretches of `size` samples the drive follows every command.

    Cutting the commands would not do: the input bias counts before the limit, so that the motor gets none of it there.
    """
    cut = np.abs(voltage) > (1.0 - _NEAR_LIMIT) * (math.inf if limit is None else limit)
    total = np.concatenate(([0], np.cumsum(cut)))
    return np.asarray(total[size:] == total[:-size])


def _least_speed(window: Window, servo: Servo, speed: Array, kernel: Array) -> float:
    """Speed (rad/s) above which rows count: relative to the highest one and to the noise of the angle."""
    assert window.theta_m is not None
    third = np.diff(window.theta_m, 3)  # of smooth motion almost nothing
    white = float(np.median(np.abs(third))) / (0.6745 * math.sqrt(20.0))
    noise = max(white, servo.encoder_resolution / math.sqrt(12.0))
    of_speed = noise * float(np.sqrt(kernel @ kernel)) * window.sample_rate
    return max(_MOVING * float(np.max(np.abs(speed))), _ABOVE_NOISE * of_speed)


@lru_cache(maxsize=8)
def gaussian_filters(width: float) -> Array:
    """(4, n) weights of a Gaussian of `width` samples about its middle: of a held signal, and of the derivatives of one
    to three samples^-1 of a sampled one."""
    # Here, because scipy.special takes long to import and many processes estimate nothing.
    from scipy.special import erf

    reach = math.ceil(_REACH * width)
    edges = erf(np.arange(-reach, reach + 2) / (width * math.sqrt(2.0)))
    place = np.arange(-reach, reach + 1) / width
    bell = np.exp(-0.5 * place**2) / (width * math.sqrt(2.0 * math.pi))
    # The derivative at the middle weighs a sample by that of the bell at its distance back.
    shapes = (bell * place / width, bell * (place**2 - 1.0) / width**2, bell * (place**3 - 3.0 * place) / width**3)
    return np.stack([0.5 * np.diff(edges), *shapes])
