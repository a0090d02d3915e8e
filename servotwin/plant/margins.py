"""Crossovers, margins, sensitivity peak and bandwidth of a loop, from its frequency response.

The response is searched on frequencies that resolve every pole and zero; every crossing and peak is then refined to
rounding. A model, a model with a delay and measured data go the same way. Roots of polynomials are not used: those of a
chain of many masses, or of a stiff one, are too ill-conditioned.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servotwin.plant.linear import Complex, LinearSystem
from servotwin.plant.signals import Array

_PER_DECADE = 60
# Frequencies about each pole and zero, in its half widths.
_ABOUT_RESONANCE = np.array([-8.0, -4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0, 8.0])
# Least half width of a pole or zero as a part of its modulus: an undamped one has none of its own.
_NARROWEST = 1e-6
# An extreme between two frequencies may cross zero unnoticed if the samples come this close to it, in the units of the
# searched function: the frequencies resolve every resonance, so extremes are off by far less.
_NEAR = 0.2
_DISTINCT = 1e-8
_ROUNDING = 4.0 * float(np.finfo(float).eps)


@dataclass(frozen=True)
class GainCrossover:
    """A frequency with abs(L) = 1: `omega` in rad/s, and the phase margin there in rad, within (-pi, pi]."""

    omega: float
    phase_margin: float


@dataclass(frozen=True)
class PhaseCrossover:
    """A frequency at which L is real and negative: `omega` in rad/s, and the gain margin there, 1 / abs(L)."""

    omega: float
    gain_margin: float


@dataclass(frozen=True)
class Margins:
    """Distance of a loop from instability.

    Attributes
    ----------
    gain_crossovers, phase_crossovers : tuple
        All of them, by frequency.
    Ms, Ms_omega : float
        Largest abs(1 / (1 + L)) and its frequency, rad/s (inf where it is only approached); (inf, nan) for an unstable
        closed loop.
    bandwidth : float
        rad/s at which the closed loop first falls 3 dB below its gain at rest; inf where it never does.
    stable : bool
        Stability of the closed loop; without it margins mean little.
    """

    gain_crossovers: tuple[GainCrossover, ...]
    phase_crossovers: tuple[PhaseCrossover, ...]
    Ms: float
    Ms_omega: float
    bandwidth: float
    stable: bool


def margins(loop: LinearSystem, closed_loop: LinearSystem) -> Margins:
    """All margins of L and of the closed loop made from it."""
    return margins_of_response(
        loop.response,
        search_frequencies(loop, closed_loop),
        stable=closed_loop.is_stable(),
        closed_loop=closed_loop.response,
        at_rest=float(np.abs(closed_loop.response(0.0))),
        at_infinity=loop.D,
    )


def margins_of_response(
    loop: Callable[[Array], Complex],
    omega: Array,
    stable: bool,
    closed_loop: Callable[[Array], Complex] | None = None,
    at_rest: float | None = None,
    at_infinity: float = 0.0,
) -> Margins:
    """All margins of a loop that is known by its response.

    Parameters
    ----------
    loop : callable
        L(j omega) for (N,) frequencies in rad/s.
    omega : (N,) array
        rad/s, ascending: frequencies that resolve the response.
    stable : bool
        Stability of the closed loop.
    closed_loop : callable, optional
        Response of the closed loop; L / (1 + L) by default.
    at_rest : float, optional
        Gain of the closed loop at rest; that at the lowest frequency by default.
    at_infinity : float
        L at infinite frequency.
    """

    def closed(w: Array) -> Complex:
        if closed_loop is not None:
            return closed_loop(w)
        value = loop(w)
        return np.asarray(value / (1.0 + value))

    rest = float(np.abs(closed(omega[:1]))[0]) if at_rest is None else at_rest
    Ms_omega, Ms = _sensitivity_peak(loop, omega, at_infinity) if stable else (math.nan, math.inf)
    return Margins(
        gain_crossovers=_gain_crossovers(loop, omega),
        phase_crossovers=_phase_crossovers(loop, omega),
        Ms=Ms,
        Ms_omega=Ms_omega,
        bandwidth=_first_fall(closed, rest, omega),
        stable=stable,
    )


def sensitivity_peak(loop: LinearSystem, closed_loop: LinearSystem) -> float:
    """Ms alone, at a fraction of the time of all margins; of an unstable loop inf."""
    if not closed_loop.is_stable():
        return math.inf
    return _sensitivity_peak(loop.response, search_frequencies(loop, closed_loop), loop.D)[1]


def _sensitivity_peak(loop: Callable[[Array], Complex], omega: Array, at_infinity: float) -> tuple[float, float]:
    """(omega, value) of the largest 1 / abs(1 + L) of a stable loop."""
    limit = 1.0 / abs(1.0 + at_infinity)
    return max(_peak(lambda w: 1.0 / np.abs(1.0 + loop(w)), omega), (math.inf, limit), key=lambda p: p[1])


def gain_crossovers(loop: LinearSystem) -> tuple[GainCrossover, ...]:
    """All frequencies with abs(L) = 1, by frequency."""
    return _gain_crossovers(loop.response, search_frequencies(loop))


def bandwidth(closed_loop: LinearSystem) -> float:
    """rad/s at which abs(T) first falls 3 dB below abs(T(0)); inf where it never does."""
    rest = float(np.abs(closed_loop.response(0.0)))
    return _first_fall(closed_loop.response, rest, search_frequencies(closed_loop))


def _first_fall(closed_loop: Callable[[Array], Complex], rest: float, omega: Array) -> float:
    """rad/s at which a response first falls 3 dB below its gain at rest; inf where it never does, or has none."""
    if rest == 0.0:
        return math.inf
    level = math.log(rest / math.sqrt(2.0))
    falls = crossings(lambda w: _log_modulus(closed_loop(w)) - level, omega)
    return falls[0] if falls else math.inf


def peak(system: LinearSystem) -> tuple[float, float]:
    """(omega, value) of the largest abs(G) on the imaginary axis; omega = inf where it is only approached."""
    largest = _peak(lambda w: np.abs(system.response(w)), search_frequencies(system))
    return max(largest, (math.inf, abs(system.D)), key=lambda p: p[1])


def search_frequencies(*systems: LinearSystem, also: Complex | None = None) -> Array:
    """(N,) rad/s, ascending: frequencies that resolve every pole and zero, of the systems and `also` given (1/s), and
    reach beyond the outermost crossings."""
    own = [np.concatenate([system.poles(), system.zeros()]) for system in systems]
    corners = np.concatenate(own if also is None else [*own, also])
    corners = corners[np.isfinite(corners) & (np.abs(corners) > 0.0)]
    # A loop may cross over far beyond all its corners, where it is its asymptote.
    sizes = np.concatenate([np.abs(corners), *(system.asymptotic_crossovers() for system in systems)])
    low, high = (1e-2 * float(sizes.min()), 1e2 * float(sizes.max())) if sizes.size else (1e-2, 1e2)
    grid = np.geomspace(low, high, int(_PER_DECADE * (math.log10(high) - math.log10(low))) + 2)
    width = np.maximum(np.abs(corners.real), _NARROWEST * np.abs(corners))
    about = (np.abs(corners.imag) + width * _ABOUT_RESONANCE[:, None]).ravel()
    omega = np.unique(np.concatenate([grid, sizes, about[(about > low) & (about < high)]]))
    # A slope between two frequencies that differ by rounding only has no sign.
    return np.asarray(omega[np.append(True, np.diff(omega) > _DISTINCT * omega[1:])])


def crossings(value: Callable[[Array], Array], omega: Array) -> list[float]:
    """Zeros of a real function of frequency between the first and last of `omega`, ascending, to rounding.

    Parameters
    ----------
    value : callable
        Function of (N,) frequencies in rad/s, of the order of one.
    omega : (N,) array
        rad/s, ascending: frequencies between which the function has at most one extreme.
    """
    omega, values = _with_extremes(value, omega)
    above = values >= 0.0
    places = np.flatnonzero((above[:-1] != above[1:]) & np.isfinite(values[:-1]) & np.isfinite(values[1:]))
    return [_zero_between(value, float(omega[i]), float(omega[i + 1])) for i in places]


def _zero_between(value: Callable[[Array], Array], low: float, high: float) -> float:
    from scipy.optimize import brentq

    def at(w: float) -> float:
        return float(value(np.array([w]))[0])

    if (at(low) >= 0.0) == (at(high) >= 0.0):  # evaluated one by one, values about zero may round to the other sign
        return min(low, high, key=lambda w: abs(at(w)))
    return float(brentq(at, low, high, xtol=_ROUNDING * low, rtol=_ROUNDING))


def _with_extremes(value: Callable[[Array], Array], omega: Array) -> tuple[Array, Array]:
    """Frequencies and values, with the extremes between frequencies that come close to zero without crossing it."""
    values = value(omega)
    middle = values[1:-1]
    with np.errstate(invalid="ignore"):
        side = np.where(middle >= 0.0, 1.0, -1.0)
        away = (side * middle <= side * values[:-2]) & (side * middle <= side * values[2:])
        strict = (side * middle < side * values[:-2]) | (side * middle < side * values[2:])
        close = away & strict & (np.abs(middle) < _NEAR) & (middle != 0.0)
    places = np.flatnonzero(close) + 1
    extremes = np.array([_extreme(value, -side[i - 1], omega[i - 1], omega[i + 1])[0] for i in places])
    everywhere = np.append(omega, extremes)
    order = np.argsort(everywhere, kind="stable")
    return everywhere[order], np.append(values, value(extremes) if extremes.size else extremes)[order]


def _extreme(value: Callable[[Array], Array], sign: float, low: float, high: float) -> tuple[float, float]:
    """(omega, value) of the largest sign * value between two frequencies."""
    from scipy.optimize import minimize_scalar

    optimum = minimize_scalar(
        lambda w: -sign * float(value(np.array([w]))[0]),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-9 * (high - low)},
    )
    return float(optimum.x), -sign * float(optimum.fun)


def _peak(value: Callable[[Array], Array], omega: Array) -> tuple[float, float]:
    """(omega, value) of the largest value: the local peaks close to the highest sample are refined first."""
    values = value(omega)
    best = int(np.argmax(values))
    peaks = [(float(omega[best]), float(values[best]))]
    for i in np.flatnonzero(values >= (1.0 - _NEAR) * values[best]).tolist():
        low, high = max(i - 1, 0), min(i + 1, omega.size - 1)
        if values[i] >= values[low] and values[i] >= values[high] and values[i] > min(values[low], values[high]):
            peaks.append(_extreme(value, 1.0, float(omega[low]), float(omega[high])))
    return max(peaks, key=lambda p: p[1])


def _gain_crossovers(loop: Callable[[Array], Complex], omega: Array) -> tuple[GainCrossover, ...]:
    frequencies = crossings(lambda w: _log_modulus(loop(w)), omega)
    values = [complex(loop(np.array([w]))[0]) for w in frequencies]
    # The angle of -L: pi plus the phase of L, within (-pi, pi].
    return tuple(GainCrossover(w, math.atan2(-v.imag, -v.real)) for w, v in zip(frequencies, values, strict=True))


def _phase_crossovers(loop: Callable[[Array], Complex], omega: Array) -> tuple[PhaseCrossover, ...]:
    frequencies = crossings(lambda w: direction(loop(w)).imag, omega)
    values = [complex(loop(np.array([w]))[0]) for w in frequencies]
    return tuple(PhaseCrossover(w, 1.0 / abs(v)) for w, v in zip(frequencies, values, strict=True) if v.real < 0.0)


def direction(values: Complex) -> Complex:
    """Each value divided by its modulus."""
    with np.errstate(invalid="ignore", over="ignore"):  # 0 has none
        return np.asarray(values / np.abs(values))


def _log_modulus(values: Complex) -> Array:
    with np.errstate(divide="ignore"):  # a loop without gain has no crossing
        return np.log(np.abs(values))
