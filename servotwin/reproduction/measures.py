"""Measures of a run: amplitude, bias, settled, settling time, limit cycle. Plain arrays in, numbers out.

Definitions for the whole reproduction. The *tail* of a step is its last `TAIL` seconds. The *amplitude* is
half the peak-to-peak of the position over the tail; a step has *settled* when its amplitude is below `SETTLED` times
the reference amplitude; its *bias* is the reference minus the mean position over the tail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TAIL = 5.0  # s: several periods of every limit cycle seen (0.9 to 1.5 Hz), a quarter of the paper's half period
SETTLED = 0.01  # of the reference amplitude
BAND = 0.02  # of the size of the step, for settling times
DEFINITIONS = {
    "gap": "the total lost motion of the backlash",
    "tolerance": "half-width of the dead zone on the tracking error",
    "amplitude": f"half the peak-to-peak of the position over the last {TAIL:g} s of a step",
    "settled": f"an amplitude below {100 * SETTLED:g} % of the reference amplitude of 1 mm",
    "bias": f"the reference minus the mean position over the last {TAIL:g} s of a step",
    "settling time": f"from when on the position stays within {100 * BAND:g} % of the step around its end value",
    "reference": "a square wave of ±1 mm and 40 s; unipolar: 0/1 mm",
}


@dataclass(frozen=True, slots=True)
class MeasuredStep:
    """One stretch of constant reference, as measured. Lengths in m, times in s, gap (total) in rad."""

    begin: float
    end: float
    reference: float
    amplitude: float
    deviation: float
    bias: float
    settled: bool
    settling_time: float
    gap_begin: float
    gap_end: float


@dataclass(frozen=True, slots=True)
class Settling:
    """Definition of settled: the amplitude over the last `tail` s of a step is below `limit`.

    That is `SETTLED` of `scale`, the reference's amplitude, and `floor` more (all m or rad).
    """

    scale: float
    tail: float = TAIL
    floor: float = 0.0

    @property
    def limit(self) -> float:
        """Amplitude below which a step has settled."""
        return SETTLED * self.scale + self.floor


@dataclass(frozen=True, slots=True)
class MeasuredCycle:
    """A periodic oscillation: frequency in Hz (NaN without one), amplitude in the signal's unit."""

    frequency: float
    amplitude: float


def amplitude(values: Array) -> float:
    """Half the peak-to-peak of `values` (N,)."""
    return float(np.ptp(values)) / 2.0


def between(time: Array, begin: float, end: float) -> slice:
    """The samples with begin <= time < end (to within a nanosecond), as a slice."""
    first, last = np.searchsorted(time, [begin - 1e-9, end - 1e-9])
    return slice(int(first), int(last))


def tail(time: Array, end: float, length: float = TAIL) -> slice:
    """The samples of the last `length` seconds before `end`."""
    return between(time, end - length, end)


def has_settled(values: Array, scale: float) -> bool:
    """Decide: the amplitude of `values` is below `SETTLED` of `scale`."""
    return amplitude(values) < SETTLED * scale


def settling_time(time: Array, values: Array, target: float, band: float) -> float:
    """Time from time[0] until abs(values - target) stays within `band`, interpolated; inf if the last is outside."""
    outside = np.flatnonzero(np.abs(values - target) > band)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    if last + 1 == len(values):
        return float("inf")
    before, after = abs(values[last] - target), abs(values[last + 1] - target)
    share = (before - band) / (before - after)
    return float(time[last] + share * (time[last + 1] - time[last]) - time[0])


def upward_crossings(time: Array, values: Array) -> Array:
    """Times at which `values` goes from negative to non-negative, interpolated linearly."""
    first = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    share = values[first] / (values[first] - values[first + 1])
    return time[first] + share * (time[first + 1] - time[first])


def limit_cycle(time: Array, values: Array) -> MeasuredCycle:
    """Frequency and amplitude of an oscillation about its mid-range, from the mean distance of upward crossings."""
    middle = (float(values.max()) + float(values.min())) / 2.0
    crossings = upward_crossings(time, values - middle)
    periods = len(crossings) - 1
    frequency = periods / float(crossings[-1] - crossings[0]) if periods > 0 else float("nan")
    return MeasuredCycle(frequency, amplitude(values))


def peaks(values: Array) -> NDArray[np.intp]:
    """Indices of the interior local maxima of `values` (N,)."""
    rising = np.diff(values) > 0.0
    return np.flatnonzero(rising[:-1] & ~rising[1:]) + 1


def is_monotone(values: Sequence[float]) -> bool:
    """Decide: the sequence never rises, or never falls."""
    steps = np.diff(np.asarray(values, dtype=float))
    return bool(np.all(steps >= 0.0) or np.all(steps <= 0.0))


def reference_changes(time: Array, reference: Array) -> Array:
    """Begin of every stretch of constant reference, the first sample included."""
    return time[np.concatenate([[0], np.flatnonzero(np.diff(reference)) + 1])]


def steps(time: Array, position: Array, reference: Array, gap: Array, settling: Settling) -> tuple[MeasuredStep, ...]:
    """Measure every stretch of constant reference that is longer than the tail."""
    begins = reference_changes(time, reference)
    ends = [*begins[1:], time[-1]]
    pairs = [(float(b), float(e)) for b, e in zip(begins, ends, strict=True) if e - b > settling.tail]
    return tuple(_step(time, position, reference, gap, settling, begin, end) for begin, end in pairs)


def _step(
    time: Array, position: Array, reference: Array, gap: Array, settling: Settling, begin: float, end: float
) -> MeasuredStep:
    whole, last = between(time, begin, end), tail(time, end, settling.tail)
    values = position[last]
    final, goal = float(values.mean()), float(reference[whole][0])
    size = abs(goal - float(position[whole][0]))
    return MeasuredStep(
        begin=begin,
        end=end,
        reference=goal,
        amplitude=amplitude(values),
        deviation=float(values.std()),
        bias=goal - final,
        settled=amplitude(values) < settling.limit,
        settling_time=settling_time(time[whole], position[whole], final, BAND * size),
        gap_begin=float(gap[whole][0]),
        gap_end=float(gap[whole][-1]),
    )
