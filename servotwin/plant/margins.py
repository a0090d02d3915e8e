"""Crossovers, margins, sensitivity peak and bandwidth of a loop.

All are located as roots of polynomials on the imaginary axis and polished; nothing is looked up on a frequency grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial as poly

from servotwin.plant.linear import LinearSystem
from servotwin.plant.polynomials import minus, mirrored, on_axis, plus, positive_roots, squared_modulus, times
from servotwin.plant.signals import Array

_PEAK_ACCURACY = 1e-10


@dataclass(frozen=True)
class GainCrossover:
    """Where abs(L) = 1: `omega` in rad/s, and the phase margin there in rad, within (-pi, pi]."""

    omega: float
    phase_margin: float


@dataclass(frozen=True)
class PhaseCrossover:
    """Where L is real and negative: `omega` in rad/s, and the gain margin there, 1 / abs(L)."""

    omega: float
    gain_margin: float


@dataclass(frozen=True)
class Margins:
    """How far a loop is from instability.

    Attributes
    ----------
    gain_crossovers, phase_crossovers : tuple
        All of them, by frequency.
    Ms, Ms_omega : float
        Largest abs(1 / (1 + L)) and where, rad/s; (inf, nan) for an unstable closed loop.
    bandwidth : float
        rad/s, where the closed loop first falls 3 dB below its gain at rest; inf where it never does.
    stable : bool
        Of the closed loop, from its poles; without it margins mean little.
    """

    gain_crossovers: tuple[GainCrossover, ...]
    phase_crossovers: tuple[PhaseCrossover, ...]
    Ms: float
    Ms_omega: float
    bandwidth: float
    stable: bool


def margins(loop: LinearSystem, closed_loop: LinearSystem) -> Margins:
    """All margins of L and of the closed loop made from it."""
    stable = closed_loop.is_stable()
    Ms_omega, Ms = peak(loop.denominator, plus(loop.denominator, loop.numerator)) if stable else (math.nan, math.inf)
    return Margins(gain_crossovers(loop), phase_crossovers(loop), Ms, Ms_omega, bandwidth(closed_loop), stable)


def gain_crossovers(loop: LinearSystem) -> tuple[GainCrossover, ...]:
    """All frequencies with abs(L) = 1, by frequency."""
    found = level_crossings(loop.numerator, loop.denominator, 1.0)
    return tuple(GainCrossover(float(w), _margin(complex(loop.response(w)))) for w in found)


def phase_crossovers(loop: LinearSystem) -> tuple[PhaseCrossover, ...]:
    """All frequencies at which L is real and negative, by frequency."""
    numerator, denominator = loop.numerator, loop.denominator
    starts = np.sqrt(positive_roots(on_axis(times(numerator, mirrored(denominator)))[1]))

    def error(w: float) -> tuple[float, float]:
        s = 1j * w
        value = -poly.polyval(s, numerator) / poly.polyval(s, denominator)
        return math.atan2(value.imag, value.real), _log_slope(numerator, denominator, s).real

    found = [w for start in starts if (w := _polished(error, float(start))) is not None]
    values = [(float(w), float(np.abs(loop.response(w)))) for w in _distinct(found) if loop.response(w).real < 0.0]
    return tuple(PhaseCrossover(w, 1.0 / value) for w, value in values)


def bandwidth(closed_loop: LinearSystem) -> float:
    """rad/s at which abs(T) first falls 3 dB below abs(T(0)); inf where it never does."""
    at_rest = float(np.abs(closed_loop.response(0.0)))
    found = level_crossings(closed_loop.numerator, closed_loop.denominator, at_rest / math.sqrt(2.0))
    return float(found[0]) if found.size else math.inf


def level_crossings(numerator: Array, denominator: Array, level: float) -> Array:
    """(K,) rad/s, ascending: every w > 0 with abs(N(j w) / D(j w)) = level.

    They are the positive roots of abs(N)^2 - level^2 abs(D)^2 in w^2, polished by Newton's method on log abs(N / D).
    """
    difference = minus(squared_modulus(numerator), level**2 * squared_modulus(denominator))

    def error(w: float) -> tuple[float, float]:
        s = 1j * w
        value = abs(poly.polyval(s, numerator) / poly.polyval(s, denominator))
        return math.log(value / level), -_log_slope(numerator, denominator, s).imag

    starts = np.sqrt(positive_roots(difference))
    return _distinct([w for start in starts if (w := _polished(error, float(start))) is not None])


def peak(numerator: Array, denominator: Array) -> tuple[float, float]:
    """(omega, value) of the largest abs(N / D) on the imaginary axis, to 1e-10; omega = inf where only approached.

    Between two crossings of a level the function lies above it: raise the level to the value in the middle until
    nothing crosses it any more (Bruinsma and Steinbuch's two steps).
    """

    def value(w: Array) -> Array:
        return np.abs(poly.polyval(1j * w, numerator) / poly.polyval(1j * w, denominator))

    omega, level = math.inf, _at_infinity(numerator, denominator)
    candidates = np.append(0.0, np.abs(poly.polyroots(denominator)))
    while candidates.size:
        found = value(candidates)
        best = int(np.argmax(found))
        if found[best] > level:
            omega, level = float(candidates[best]), float(found[best])
        crossings = level_crossings(numerator, denominator, level * (1.0 + _PEAK_ACCURACY))
        candidates = np.sqrt(crossings[:-1] * crossings[1:])
        candidates = candidates[value(candidates) > level * (1.0 + _PEAK_ACCURACY)]
    return omega, level


def _at_infinity(numerator: Array, denominator: Array) -> float:
    """abs(N / D) for w to infinity, of a proper fraction."""
    return abs(float(numerator[-1] / denominator[-1])) if numerator.size == denominator.size else 0.0


def _margin(value: complex) -> float:
    """Phase of -L, rad."""
    return math.atan2(-value.imag, -value.real)


def _log_slope(numerator: Array, denominator: Array, s: complex) -> complex:
    """G'(s) / G(s)."""
    return complex(
        poly.polyval(s, poly.polyder(numerator)) / poly.polyval(s, numerator)
        - poly.polyval(s, poly.polyder(denominator)) / poly.polyval(s, denominator)
    )


def _polished(error: Callable[[float], tuple[float, float]], start: float) -> float | None:
    """The root near a start by Newton's method, or None when there is none within a hundredth."""
    w = start
    for _ in range(30):
        value, slope = error(w)
        step = value / slope if slope != 0.0 else 0.0
        w -= step
        if not abs(w - start) <= 0.01 * start:
            return None
        if abs(step) <= 4e-16 * w:
            break
    return w if abs(error(w)[0]) < 1e-9 else None


def _distinct(found: list[float]) -> Array:
    """Ascending, equal ones (to 1e-9) once."""
    ordered = np.sort(np.asarray(found, dtype=float))
    fresh = np.append(True, np.diff(ordered) > 1e-9 * ordered[1:]) if ordered.size else np.zeros(0, dtype=bool)
    return np.asarray(ordered[fresh])
