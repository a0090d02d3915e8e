"""The structure as the edge knows it: from the screw's angle to the position of the last mass, in plain floats.

Each mode is a recurrence of its own, z[i+1] = e z[i] + u[i], exact for an angle that is linear between samples, as in
`servotwin.estimation.core.response`, which the twin makes this of. What is judged has few samples: four moving averages
of `factor` samples each, then every `factor`-th. The model's side goes through the same, so nothing is approximated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, repeat
from math import hypot, isfinite
from operator import mul
from typing import NamedTuple

from servotwin.errors import InvalidInput

Signal = Sequence[float]
_AVERAGES = 4


class Mode(NamedTuple):
    """A pole of the structure (one of a pair): exp(pole T), and what of its state the position is the real part of."""

    decay: complex
    gain: complex


@dataclass(frozen=True, slots=True)
class NoveltyModel:
    """Structure response at one sample rate.

    Parameters
    ----------
    rate : float
        Hz.
    modes : tuple of Mode
    direct, static_gain : float
        m/rad: position over angle at once, and at rest.
    unseen : float
        s: what the screw does so late in a window has not reached the last mass.
    factor : int
        Samples per sample that is judged.
    """

    rate: float
    modes: tuple[Mode, ...]
    direct: float
    static_gain: float
    unseen: float
    factor: int = 1

    def __post_init__(self) -> None:
        numbers = [part for mode in self.modes for value in mode for part in (value.real, value.imag)]
        if not all(map(isfinite, (*numbers, self.direct, self.static_gain))):
            raise InvalidInput("novelty model: modes and gains must be finite")
        if not self.modes or max(hypot(mode.decay.real, mode.decay.imag) for mode in self.modes) >= 1.0:
            raise InvalidInput("novelty model: needs modes, all of which decay")
        if not (isfinite(self.rate) and self.rate > 0.0):
            raise InvalidInput(f"novelty model sample rate = {self.rate!r} Hz: must be greater than 0")
        if self.static_gain == 0.0:
            raise InvalidInput("novelty model static gain = 0 m/rad: must be another number")
        if not 0.0 <= self.unseen < 1e6:
            raise InvalidInput(f"novelty model unseen = {self.unseen!r} s: must be at least 0")
        if self.factor < 1:
            raise InvalidInput(f"novelty model decimation = {self.factor!r} samples: must be at least 1")

    def respond(self, angle: Signal) -> list[float]:
        """(n,) positions (m) for the screw's angle (n,) rad, from rest at zero one sample before the first."""
        out = [self.direct * u for u in angle]
        modes = self.modes if len(self.modes) % 2 == 0 else (*self.modes, Mode(0j, 0j))
        for one, other in zip(modes[::2], modes[1::2], strict=True):
            out = _with_pair(out, angle, one, other)
        return out

    def free(self, samples: int) -> list[list[float]]:
        """Motions (n,) of the unforced structure, real and imaginary part of each mode, of size 1 at first."""
        rows = []
        for decay, _ in self.modes:
            motion = list(accumulate(repeat(decay, samples - 1), mul, initial=1.0 + 0.0j))
            rows.append([z.real for z in motion])
            if decay.imag != 0.0:
                rows.append([z.imag for z in motion])
        return rows

    def decimated(self, signal: Signal) -> list[float]:
        """(m,) of (n,), m = n // factor - 3: moving averages, then every `factor`-th."""
        return decimated(signal, self.factor)


def _with_pair(out: list[float], angle: Signal, one: Mode, other: Mode) -> list[float]:
    """What two modes add to an output."""
    (decay, gain), (slow, weight) = one, other
    x = y = 0j
    answer = []
    for before, u in zip(out, angle, strict=True):
        answer.append(before + (gain * x + weight * y).real)
        x = decay * x + u
        y = slow * y + u
    return answer


@lru_cache(maxsize=8)
def _taps(factor: int) -> tuple[tuple[float, ...], ...]:
    """Four moving averages in a row as one filter, in four blocks of `factor` taps."""
    taps = [1.0]
    for _ in range(_AVERAGES):
        spread = [0.0] * (len(taps) + factor - 1)
        for i, tap in enumerate(taps):
            for k in range(factor):
                spread[i + k] += tap / factor
        taps = spread
    taps += [0.0] * (_AVERAGES * factor - len(taps))
    return tuple(tuple(taps[k * factor : (k + 1) * factor]) for k in range(_AVERAGES))


def decimated(signal: Signal, factor: int) -> list[float]:
    """As `NoveltyModel.decimated`; a factor of 1 leaves everything as it is."""
    if factor == 1:
        return list(signal)
    a, b, c, d = _taps(factor)
    out, first, second, third = [], 0.0, 0.0, 0.0
    for begin in range(0, len(signal) // factor * factor, factor):
        block = signal[begin : begin + factor]
        out.append(first + sum(map(mul, d, block)))
        first = second + sum(map(mul, c, block))
        second = third + sum(map(mul, b, block))
        third = sum(map(mul, a, block))
    return out[_AVERAGES - 1 :]


def smoothed(signal: list[float], factor: int) -> list[float]:
    """The moving averages at the full rate: sample i stands for samples i .. i + 4 (factor - 1) of the signal."""
    if factor == 1:
        return signal
    for _ in range(_AVERAGES):
        total = [0.0, *accumulate(signal)]
        signal = [(after - before) / factor for before, after in zip(total, total[factor:], strict=False)]
    return signal


class Fixed(NamedTuple):
    """What does not depend on a window's samples, only on how many there are.

    Attributes
    ----------
    nuisances : list of (m,)
        A constant, and the structure's motion from before the window.
    step : list
        Smoothed response to a step of the screw by 1 rad, at the full rate, from `lead` samples before it on.
    lead : int
    """

    nuisances: list[list[float]]
    step: list[float]
    lead: int

    def stepped(self, changes: Sequence[tuple[int, float]], factor: int) -> list[float]:
        """(m,) judged samples of the response to steps: (sample, size in rad)."""
        count = len(self.nuisances[0])
        out = [0.0] * count
        for sample, size in changes:
            quiet = max(0, -((self.lead - sample) // factor))
            part = self.step[self.lead - sample + quiet * factor :: factor]
            for j, value in enumerate(part[: max(0, count - quiet)], quiet):
                out[j] += size * value
        return out


@lru_cache(maxsize=8)
def fixed(model: NoveltyModel, samples: int) -> Fixed:
    """For windows of so many samples."""
    nuisances = [decimated(row, model.factor) for row in ([1.0] * samples, *model.free(samples))]
    lead = _AVERAGES * (model.factor - 1)
    step = smoothed([0.0] * lead + model.respond([1.0] * (samples + lead)), model.factor)
    return Fixed(nuisances, step, lead)
