"""Signals of time as piecewise cubics: references, gaps, tolerances.

A cubic is what the hybrid kernel integrates exactly (four exosystem states), and a smoothstep, a step and a
square wave are all piecewise cubic, so every signal comes down to one `PiecewiseCubic`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput

Array: TypeAlias = NDArray[np.float64]
LARGEST_GAP = 2.0 * math.pi
"""Largest total gap that is accepted, rad: a number above it is nearly always an angle in degrees."""
_ROUNDING = 64 * float(np.finfo(float).eps)
_SMALLEST = float(np.finfo(float).tiny)
_MOST_PIECES = 1e7
_TIME_ROUNDING = 4 * float(np.finfo(float).eps)


@runtime_checkable
class Signal(Protocol):
    """Any function of time that can be written as cubics on [0, duration]."""

    def pieces(self, duration: float, /) -> PiecewiseCubic: ...


@dataclass(frozen=True, eq=False)
class PiecewiseCubic:
    """A function of time made of cubics, right-continuous at its jumps.

    Parameters
    ----------
    times : (M,) array
        s, increasing, the first at 0 or earlier; piece i holds on [times[i], times[i + 1]), the last for ever.
    coeffs : (M, 4) array
        Ascending powers of (t - times[i]).

    Raises
    ------
    InvalidInput
        Shapes do not match, a number is not finite, or the times do not increase from 0 or earlier.
    """

    times: Array
    coeffs: Array

    def __init__(self, times: ArrayLike, coeffs: ArrayLike) -> None:
        object.__setattr__(self, "times", _frozen(times, "times"))
        object.__setattr__(self, "coeffs", _frozen(coeffs, "coeffs"))
        if self.times.ndim != 1 or self.times.size == 0 or self.coeffs.shape != (self.times.size, 4):
            raise InvalidInput(
                "a piecewise cubic needs times (M,) and coeffs (M, 4) with M >= 1, "
                f"not {self.times.shape} and {self.coeffs.shape}"
            )
        if self.times[0] > 0.0 or not np.all(np.diff(self.times) > 0.0):
            raise InvalidInput("the times of a piecewise cubic must increase, and the first must be 0 s or earlier")

    @classmethod
    def constant(cls, value: float) -> PiecewiseCubic:
        """The same value at all times."""
        return cls([0.0], [[value, 0.0, 0.0, 0.0]])

    @classmethod
    def zero_order_hold(cls, times: ArrayLike, values: ArrayLike) -> PiecewiseCubic:
        """Each value from its time until the next one."""
        values = np.asarray(values, dtype=float)
        coeffs = np.zeros((values.size, 4))
        coeffs[:, 0] = values
        return cls(times, coeffs)

    def pieces(self, _duration: float, /) -> PiecewiseCubic:
        """Return itself: a piecewise cubic holds for ever."""
        return self

    def value(self, t: ArrayLike) -> Array:
        """Value at time t (scalar or array), the right limit at a jump; before times[0] the first value holds.

        A time that rounding puts just before a knot (sample 1500 at 5 kHz, the third knot of 0.1 s) is at it.
        """
        t = np.asarray(t, dtype=float)
        piece = np.clip(np.searchsorted(self.times, _rounded_up(t), side="right") - 1, 0, None)
        elapsed = np.maximum(t - self.times[piece], 0.0)
        c = self.coeffs[piece]
        return np.asarray(((c[..., 3] * elapsed + c[..., 2]) * elapsed + c[..., 1]) * elapsed + c[..., 0])

    def constant_between(self, first: float, last: float) -> float | None:
        """The value from one time to another, where it does not change; None where it may."""
        pieces = np.searchsorted(self.times, _rounded_up(np.array([first, last])), side="right")
        piece = max(int(pieces[0]) - 1, 0)
        return float(self.coeffs[piece, 0]) if pieces[0] == pieces[1] and not self.coeffs[piece, 1:].any() else None

    def on(self, times: Array) -> Array:
        """`value` at increasing times ``(n,)``, piece by piece: quicker where there are many times in few pieces."""
        if times.size == 0:
            return np.empty(0)
        constant = self.constant_between(float(times[0]), float(times[-1]))
        if constant is not None:
            return np.full(times.size, constant)
        result = np.empty(times.size)
        bounds = np.concatenate([[0], np.searchsorted(_rounded_up(times), self.times[1:], side="left"), [times.size]])
        for piece in np.flatnonzero(np.diff(bounds)):
            part = slice(bounds[piece], bounds[piece + 1])
            varies = bool(np.any(self.coeffs[piece, 1:]))
            result[part] = self.value(times[part]) if varies else self.coeffs[piece, 0]
        return result

    @property
    def jumps(self) -> Array:
        """(K,) times at which the value is discontinuous (rounding of the cubic's end value does not count)."""
        span = np.diff(self.times)
        powers = span[:, None] ** np.arange(4)
        left = np.sum(self.coeffs[:-1] * powers, axis=1)
        right = self.coeffs[1:, 0]
        scale = np.sum(np.abs(self.coeffs[:-1]) * powers, axis=1) + np.abs(right)
        jumped: Array = self.times[1:][np.abs(right - left) > np.maximum(_ROUNDING * scale, _SMALLEST)]
        return jumped

    def changes(self, duration: float) -> Array:
        """Times of [0, duration) at which the value jumps; 0 counts when the value there is not zero."""
        inside = self.jumps[(self.jumps > 0.0) & (self.jumps < duration)]
        starts = [0.0] if self.value(0.0) != 0.0 and duration > 0.0 else []
        return np.concatenate([starts, inside])

    def minimum(self, duration: float) -> tuple[float, float]:
        """(time, value) of the lowest point on [0, duration], from the roots of each cubic's derivative."""
        best = (0.0, float(self.value(0.0)))
        ends = np.append(self.times[1:], math.inf)
        for start, end, c in zip(self.times, ends, self.coeffs, strict=True):
            first, last = max(start, 0.0) - start, min(end, duration) - start
            if first > last:
                continue
            for elapsed in _candidates(c, first, last):
                value = float(((c[3] * elapsed + c[2]) * elapsed + c[1]) * elapsed + c[0])
                if value < best[1]:
                    best = (min(float(start + elapsed), duration), value)
        return best

    def scaled(self, factor: float) -> PiecewiseCubic:
        """The same shape, every value times `factor`."""
        return PiecewiseCubic(self.times, self.coeffs * factor)

    def later(self, time: float) -> PiecewiseCubic:
        """Rest of the signal from a time (s, at least 0) on, as a signal that begins there."""
        first = max(int(np.searchsorted(self.times, time, side="right")) - 1, 0)
        return PiecewiseCubic(self.times[first:] - time, self.coeffs[first:])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PiecewiseCubic):
            return NotImplemented
        return np.array_equal(self.times, other.times) and np.array_equal(self.coeffs, other.coeffs)

    def __hash__(self) -> int:
        return hash((self.times.tobytes(), self.coeffs.tobytes()))


@dataclass(frozen=True)
class SCurve:
    """Smoothstep 3 u^2 - 2 u^3 from one value to another, constant before and after.

    Parameters
    ----------
    begin_value, end_value : float
        Values before `begin` and after `begin + duration`.
    duration : float
        s, how long the change takes.
    begin : float
        s, when it starts.
    """

    begin_value: float
    end_value: float
    duration: float
    begin: float = 0.0

    def __post_init__(self) -> None:
        _finite("SCurve", begin_value=self.begin_value, end_value=self.end_value, begin=self.begin)
        _positive("SCurve", "s", duration=self.duration)
        if not 1e-90 < self.duration < 1e90:  # its cube is a number
            raise InvalidInput(f"SCurve: duration = {self.duration} s must lie between 1e-90 and 1e90 s")

    def pieces(self, _duration: float, /) -> PiecewiseCubic:
        """The ramp as one cubic between two constants."""
        rise = self.end_value - self.begin_value
        ramp = [self.begin_value, 0.0, 3.0 * rise / self.duration**2, -2.0 * rise / self.duration**3]
        times = [self.begin, self.begin + self.duration]
        coeffs = [ramp, [self.end_value, 0.0, 0.0, 0.0]]
        if self.begin > 0.0:
            times, coeffs = [0.0, *times], [[self.begin_value, 0.0, 0.0, 0.0], *coeffs]
        return PiecewiseCubic(times, coeffs)


@dataclass(frozen=True)
class Step:
    """Zero, then `size` from time `at` (s) on."""

    size: float
    at: float = 0.0

    def __post_init__(self) -> None:
        _finite("Step", size=self.size, at=self.at)

    def pieces(self, _duration: float, /) -> PiecewiseCubic:
        """One constant, or two when the step comes later."""
        if self.at <= 0.0:
            return PiecewiseCubic.constant(self.size)
        return PiecewiseCubic.zero_order_hold([0.0, self.at], [0.0, self.size])


@dataclass(frozen=True)
class SquareWave:
    """offset + amplitude in the first half of each period (s), offset - amplitude in the second."""

    amplitude: float
    period: float
    offset: float = 0.0

    def __post_init__(self) -> None:
        _finite("SquareWave", amplitude=self.amplitude, offset=self.offset)
        _positive("SquareWave", "s", period=self.period)

    def pieces(self, duration: float, /) -> PiecewiseCubic:
        """One constant per half period that starts on [0, duration]."""
        return self.between(0.0, max(duration, 0.0))

    def between(self, begin: float, end: float) -> PiecewiseCubic:
        """The wave from `begin` (at least 0) to `end` (s), for a run without an end; earlier values are arbitrary."""
        count = 2.0 * (end - begin) / self.period
        if not count <= _MOST_PIECES:
            shown = f"SquareWave period = {self.period!r} s: gives {count:.3g} half periods in {end - begin!r} s"
            raise InvalidInput(f"{shown}; at most {_MOST_PIECES:g} are allowed")
        halves = np.arange(math.floor(2.0 * begin / self.period), math.floor(2.0 * end / self.period) + 1)
        times, values = halves * (0.5 * self.period), self.offset + self.amplitude * (-1.0) ** halves
        return PiecewiseCubic.zero_order_hold(np.append(0.0, times[1:]), values)


@dataclass(frozen=True)
class Samples:
    """Recorded values, each held until the next one; the first also holds before its time.

    Parameters
    ----------
    times : sequence of float
        s, increasing.
    values : sequence of float
        One for each time.
    """

    times: Sequence[float]
    values: Sequence[float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", tuple(float(t) for t in self.times))
        object.__setattr__(self, "values", tuple(float(v) for v in self.values))
        if not self.times or len(self.times) != len(self.values):
            raise InvalidInput(f"Samples needs one value for each time, not {len(self.values)} for {len(self.times)}")
        if any(after <= before for before, after in zip(self.times, self.times[1:], strict=False)):
            raise InvalidInput("the times of Samples must increase")

    def pieces(self, _duration: float, /) -> PiecewiseCubic:
        """One constant per sample."""
        return PiecewiseCubic.zero_order_hold([min(self.times[0], 0.0), *self.times[1:]], self.values)


SignalLike: TypeAlias = Signal | float


def as_pieces(signal: SignalLike, duration: float) -> PiecewiseCubic:
    """The piecewise cubic of a signal or of a plain number on [0, duration].

    Raises
    ------
    InvalidInput
        It is neither a number nor a signal, or it is not finite.
    """
    if isinstance(signal, Signal):
        return signal.pieces(duration)
    try:
        return PiecewiseCubic.constant(float(signal))
    except (TypeError, ValueError) as error:
        if isinstance(error, InvalidInput):
            raise
        raise InvalidInput(
            f"{signal!r} is not a signal; give a number, SCurve, Step, SquareWave, Samples or PiecewiseCubic"
        ) from None


def as_nonnegative(signal: SignalLike, duration: float, name: str = "gap", unit: str = "rad") -> PiecewiseCubic:
    """Convert as `as_pieces`, and refuse a signal that is negative anywhere on [0, duration].

    Raises
    ------
    InvalidInput
        The message names the lowest point's time and value, or the number that is not finite.
    """
    if isinstance(signal, int | float) and not math.isfinite(signal):
        raise InvalidInput(f"{name} = {signal} {unit}: must be finite and 0 or more")
    pieces = as_pieces(signal, duration)
    time, value = pieces.minimum(duration)
    if value < -_ROUNDING * float(np.max(np.abs(pieces.value(np.append(pieces.times, duration))))):
        raise InvalidInput(f"{name} = {value:.6g} {unit} at t = {time:.6g} s is negative; it must be 0 {unit} or more")
    return pieces


def as_gap(signal: SignalLike, duration: float, largest: float = LARGEST_GAP) -> PiecewiseCubic:
    """Convert as `as_nonnegative`, and refuse a total gap (rad) above the largest one of the machine.

    Raises
    ------
    InvalidInput
        As `as_nonnegative`; also for a larger gap, nearly always an angle in degrees.
    """
    pieces = as_nonnegative(signal, duration)
    check_gap(-pieces.scaled(-1.0).minimum(duration)[1], largest=largest)
    return pieces


def check_gap(gap: float, name: str = "gap", largest: float = LARGEST_GAP) -> None:
    """Refuse a total gap (rad) above the largest one: one turn of the motor, of a gear one turn of the load.

    Raises
    ------
    InvalidInput
        The message shows the angle in degrees and suggests math.radians.
    """
    # The rounding of degrees to radians.
    if gap > largest * (1.0 + 1e-12):
        raise InvalidInput(
            f"{name} = {gap:.6g} rad ({math.degrees(gap):.0f} deg): the total gap is an angle in rad of at most"
            f" {turn_in_words(largest)} ({'2 pi' if largest == LARGEST_GAP else f'{largest:.6g}'});"
            f" did you mean math.radians({gap:.6g})?"
        )


def turn_in_words(largest: float) -> str:
    """The largest gap of a machine (rad) in words."""
    return "one turn" if largest == LARGEST_GAP else "one turn of the load"


def reference_changes(signal: SignalLike, duration: float) -> Array:
    """Times of [0, duration) at which a signal jumps; 0 counts when it does not start at zero."""
    return as_pieces(signal, duration).changes(duration)


def _rounded_up(t: Array) -> Array:
    return t + _TIME_ROUNDING * np.abs(t)


def _candidates(c: Array, first: float, last: float) -> list[float]:
    """Both ends and the derivative's real roots between them (elapsed times), without cancellation."""
    constant, half_slope, square = float(c[1]), float(c[2]), 3.0 * float(c[3])
    discriminant = half_slope**2 - square * constant
    if discriminant < 0.0:
        return [first, last]
    larger = -(half_slope + math.copysign(math.sqrt(discriminant), half_slope))
    roots = [a / b for a, b in ((larger, square), (constant, larger)) if abs(b) * last > abs(a)]
    return [first, last, *(root for root in roots if first < root < last)]


def _frozen(values: ArrayLike, name: str) -> Array:
    array = np.array(values, dtype=float)
    if not np.all(np.isfinite(array)):
        raise InvalidInput(f"{name} of a piecewise cubic must be finite")
    array.flags.writeable = False
    return array


def _finite(owner: str, **numbers: float) -> None:
    for name, value in numbers.items():
        if not math.isfinite(value):
            raise InvalidInput(f"{owner}: {name} = {value} must be finite")


def _positive(owner: str, unit: str, **numbers: float) -> None:
    for name, value in numbers.items():
        if not (math.isfinite(value) and value > 0.0):
            raise InvalidInput(f"{owner}: {name} = {value} {unit} must be positive and finite")
