"""Window of measurements: the input of every estimator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from servotwin.errors import InvalidInput
from servotwin.plant.signals import Array
from servotwin.runtime.notebook import html_table
from servotwin.simulation.views import Panel, stacked_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MINIMUM_SAMPLES = 16
CHANNELS = {"position": "m", "theta_m": "rad", "voltage": "V", "reference": "m"}
_OTHERS = tuple(name for name in CHANNELS if name != "position")
_ROUNDING = 1e-9  # of the motion
_LARGEST = 1e100  # of a sample, in its unit: squares of larger ones overflow
_JITTER = 0.05  # of a sample interval: largest deviation of (rounded) time stamps from a uniform grid


class RunLike(Protocol):
    """The part of a simulated run that a window is cut from."""

    @property
    def time(self) -> Array: ...
    @property
    def sample_rate(self) -> float: ...
    def measured(self, name: str) -> Array: ...


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Window:
    """Uniformly sampled measurements of one servo, each channel `(n,)` float64, read-only.

    Parameters
    ----------
    position : (n,) array_like, optional
        Measured position of the last mass, m; at least 16 samples. Without it only the method "motor_side" estimates.
    theta_m : (n,) array_like, optional
        Motor angle, rad; needed without a position.
    voltage : (n,) array_like, optional
        Motor voltage, V.
    reference : (n,) array_like, optional
        Position reference, m.
    sample_rate : float, optional
        Hz.
    time : (n,) array_like, optional
        Sample times, s, uniformly spaced; gives rate and start. Exactly one of `sample_rate` and `time` is needed.
    start : float
        Time of the first sample, s; only with `sample_rate`.
    source : str, optional
        Origin of the window in words; error messages begin with it.

    Raises
    ------
    InvalidInput
        A channel is not one-dimensional, has another length than the first, is too short or holds a value that is not
        finite; the rate is missing, doubled or not positive; the times are not uniform.
    """

    measured_position: Array | None
    theta_m: Array | None
    voltage: Array | None
    reference: Array | None
    sample_rate: float
    start: float
    source: str | None

    def __init__(
        self,
        position: ArrayLike | None = None,
        theta_m: ArrayLike | None = None,
        voltage: ArrayLike | None = None,
        reference: ArrayLike | None = None,
        sample_rate: float | None = None,
        time: ArrayLike | None = None,
        start: float = 0.0,
        source: str | None = None,
    ) -> None:
        where = f"{source}: " if source else ""
        given = {"position": position, "theta_m": theta_m, "voltage": voltage, "reference": reference}
        channels = {name: None if v is None else _channel(where, name, v) for name, v in given.items()}
        size = _common_size(where, channels)
        rate, start = _timing(where, size, sample_rate, time, start)
        channels["measured_position"] = channels.pop("position")
        for name, value in {**channels, "sample_rate": rate, "start": start, "source": source}.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        """Source, span, rate and channels in one line."""
        span = f"{self.start:.6g} .. {self.start + self.duration:.6g} s at {self.sample_rate:g} Hz"
        return f"<Window {self.where}{span}: {', '.join(self.channels)}>"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        ranges = {
            name: f"{values.min():.6g} .. {values.max():.6g} {CHANNELS[name]}" for name, values in self.channels.items()
        }
        end = self.start + self.duration
        rows = {"time": f"{self.start:.6g} .. {end:.6g} s", "sample rate": f"{self.sample_rate:g} Hz", **ranges}
        return html_table(f"Window {self.source or ''}".strip(), rows)

    def plot(self) -> Figure:
        """Figure of every channel over time.

        Raises
        ------
        InvalidInput
            matplotlib is not installed.
        """
        panels = [Panel(f"{name}, {CHANNELS[name]}", {name: values}) for name, values in self.channels.items()]
        return stacked_figure(repr(self).strip("<>"), self.time, panels)

    @classmethod
    def from_run(cls, run: RunLike, start: float, duration: float) -> Window:
        """Cut the measured samples of a simulated run from `start` (s) on, `duration` (s) long.

        The last sample is one interval before the end.

        Raises
        ------
        InvalidInput
            The run does not cover the window.
        """
        begin, rate = float(run.time[0]), run.sample_rate
        part = _samples("run: ", begin, rate, run.time.size, start, duration)
        measured = {name: run.measured(name)[part] for name in CHANNELS}
        # Without an encoder there is no reading.
        channels: dict[str, Any] = {name: v for name, v in measured.items() if not np.isnan(v).all()}
        return cls(**channels, sample_rate=rate, start=begin + part.start / rate)

    def follows_motor(self, ratio: float, within: float = 0.0) -> bool:
        """True where position less ratio (m/rad) times theta_m is constant, but for `within` (m) and rounding."""
        if self.measured_position is None or self.theta_m is None:
            return False
        lead = self.measured_position - ratio * self.theta_m
        return bool(np.ptp(lead) <= within + _ROUNDING * np.ptp(self.measured_position))

    def slice(self, start: float, duration: float) -> Window:
        """Cut the part of `duration` (s) from the sample nearest to `start` (s, on the window's own clock)."""
        rate = self.sample_rate
        part = _samples(self.where, self.start, rate, self.samples, start, duration)
        channels: dict[str, Any] = {name: value[part] for name, value in self.channels.items()}
        return Window(**channels, sample_rate=rate, start=self.start + part.start / rate, source=self.source)

    def replace(self, **channels: ArrayLike) -> Window:
        """Copy the window with other samples in some channels; they are validated again."""
        kept: dict[str, Any] = {**self.channels, **channels}
        return Window(**kept, sample_rate=self.sample_rate, start=self.start, source=self.source)

    def driven(self, limit: float | None) -> Window:
        """The window with the voltage that a drive gives that follows commands up to `limit` (V); None: any command."""
        if self.voltage is None or limit is None or float(np.max(np.abs(self.voltage))) <= limit:
            return self
        return self.replace(voltage=np.clip(self.voltage, -limit, limit))

    @property
    def has_position(self) -> bool:
        """True where the load's position was measured."""
        return self.measured_position is not None

    @property
    def position(self) -> Array:
        """(n,) measured position of the last mass, m.

        Raises
        ------
        InvalidInput
            The window has none.
        """
        if self.measured_position is None:
            raise InvalidInput(
                f"{self.where}the window has no position of the load: give it, or method = 'motor_side', which "
                "needs the motor's angle and the command"
            )
        return self.measured_position

    @property
    def samples(self) -> int:
        """Number of samples, n."""
        return next(iter(self.channels.values())).size

    @property
    def channels(self) -> Mapping[str, Array]:
        """The channels that were measured, by name."""
        values = {"position": self.measured_position} | {name: getattr(self, name) for name in _OTHERS}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def time(self) -> Array:
        """(n,) sample times, s."""
        return self.start + np.arange(self.samples) / self.sample_rate

    @property
    def duration(self) -> float:
        """Number of samples over sample rate, s."""
        return self.samples / self.sample_rate

    @property
    def mid_time(self) -> float:
        """Time half-way between the first and the last sample, s."""
        return self.start + 0.5 * (self.samples - 1) / self.sample_rate

    @property
    def where(self) -> str:
        """Beginning of a message about this window."""
        return f"{self.source}: " if self.source else ""


def _samples(where: str, begin: float, rate: float, size: int, start: float, duration: float) -> slice:
    """Slice the samples from `start` (s) for `duration` (s) out of `size` at `rate` (Hz), the first at `begin` (s)."""
    first = round((_number(where, "start", "s", start) - begin) * rate)
    last = first + round(_number(where, "duration", "s", duration) * rate)
    if not 0 <= first < last <= size:
        raise InvalidInput(
            f"{where}a window of {duration:.9g} s from {start:.9g} s does not lie within the measurements, "
            f"which last from {begin:.9g} s to {begin + size / rate:.9g} s"
        )
    return slice(first, last)


def _channel(where: str, name: str, values: ArrayLike) -> Array:
    try:
        samples = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidInput(f"{where}{name} must be an array of numbers in {CHANNELS[name]}") from None
    if samples.ndim != 1 or samples.size < MINIMUM_SAMPLES:
        raise InvalidInput(f"{where}{name} has shape {samples.shape}: must be (n,) with n >= {MINIMUM_SAMPLES} samples")
    usable = np.abs(samples) <= _LARGEST
    if not usable.all():
        index = int(np.argmin(usable))
        raise InvalidInput(
            f"{where}{name}[{index}] = {samples[index]} {CHANNELS[name]}: every sample must be a finite number"
            f"{f' of at most {_LARGEST:g}' if np.isfinite(samples[index]) else ''}"
        )
    samples.flags.writeable = False
    return samples


def _common_size(where: str, channels: Mapping[str, Array | None]) -> int:
    """Check that all measured channels have as many samples as the first; return that number."""
    sizes = {name: samples.size for name, samples in channels.items() if samples is not None}
    if not {"position", "theta_m"} & sizes.keys():
        raise InvalidInput(f"{where}the window has neither position nor theta_m: must have one of them")
    first, size = next(iter(sizes.items()))
    for name, other in sizes.items():
        if other != size:
            raise InvalidInput(f"{where}{name} has {other} samples and {first} {size}: must be equally many")
    return size


def _timing(
    where: str, size: int, sample_rate: float | None, time: ArrayLike | None, start: float
) -> tuple[float, float]:
    """(sample rate, Hz; time of the first sample, s)."""
    if (sample_rate is None) == (time is None):
        raise InvalidInput(f"{where}a window needs exactly one of sample_rate (Hz) and time (s)")
    if time is not None:
        return _uniform(where, size, time, start)
    rate = _number(where, "sample_rate", "Hz", sample_rate)
    if rate <= 0.0:
        raise InvalidInput(f"{where}sample_rate = {rate!r} Hz: must be greater than 0")
    return rate, _number(where, "start", "s", start)


def _number(where: str, name: str, unit: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise InvalidInput(f"{where}{name} = {value!r} {unit}: must be a finite number")
    return number


def _uniform(where: str, size: int, time: ArrayLike, start: float) -> tuple[float, float]:
    """(sample rate, Hz; start, s) of uniformly spaced times."""
    if start != 0.0:
        raise InvalidInput(
            f"{where}start = {start!r} s: must be left out where time is given, because time[0] is the start"
        )
    times = np.array(time, dtype=np.float64)
    if times.shape != (size,):
        raise InvalidInput(f"{where}time has shape {times.shape} and position ({size},): must be equal")
    interval = (times[-1] - times[0]) / (size - 1)
    off_grid = ~(np.abs(times - (times[0] + interval * np.arange(size))) < _JITTER * interval)
    wrong = np.flatnonzero(off_grid if np.all(np.isfinite(times)) else ~np.isfinite(times))
    if wrong.size:
        index, after, steps = int(wrong[0]), "", np.diff(times)
        if np.all(np.isfinite(times)):
            # Where samples are missing the whole grid is off: the step that is least like the others is the place.
            index = int(np.argmax(np.abs(steps - np.median(steps)))) + 1
            after = f", {steps[index - 1]:.6g} s after the sample before"
        words = "must be finite, increasing, uniformly spaced"
        raise InvalidInput(f"{where}time[{index}] = {times[index]} s{after}: {words}")
    return 1.0 / interval, float(times[0])
