"""A plant for tuning: a linear system or a measured frequency response, with a delay; and the stability of its loop."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array
from servotwin.plant.linear import Complex, LinearSystem

# Frequencies about each pole and zero of the plant, in its half widths.
_CLUSTER = np.linspace(-8.0, 8.0, 49)
_PER_DECADE = 60
_AXIS = 1e-9


@dataclass(frozen=True, eq=False)
class FrequencyData:
    """A measured frequency response.

    Parameters
    ----------
    omega : (N,) array
        rad/s, ascending, positive, at least 4.
    values : (N,) complex array
        G(j omega); between the points log modulus and phase are linear in log omega.
    integrators : int
        Poles at 0; every other pole is stable, which the data cannot tell.

    Raises
    ------
    InvalidInput
        The arrays do not fit, or a number is not finite or zero.
    """

    omega: ArrayLike
    values: ArrayLike
    integrators: int = 0
    _log: tuple[Array, Array, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        omega, values = np.asarray(self.omega, dtype=float), np.asarray(self.values, dtype=complex)
        if omega.ndim != 1 or omega.size < 4 or values.shape != omega.shape:
            raise InvalidInput(
                f"frequency data: omega {omega.shape} and values {values.shape} must both be (N,), N >= 4"
            )
        if not (np.isfinite(omega).all() and omega[0] > 0.0 and np.all(np.diff(omega) > 0.0)):
            raise InvalidInput("frequency data: omega must be finite, positive and ascending, in rad/s")
        if not np.isfinite(values).all() or np.any(values == 0.0):
            raise InvalidInput("frequency data: every value must be finite and not 0")
        logs = (np.log(omega), np.log(np.abs(values)), np.unwrap(np.angle(values)))
        object.__setattr__(self, "_log", logs)

    def response(self, omega: ArrayLike) -> Complex:
        """G(j omega), interpolated; outside the data the nearest end's."""
        at = np.log(np.asarray(omega, dtype=float))
        places, modulus, phase = self._log
        return np.asarray(np.exp(np.interp(at, places, modulus) + 1j * np.interp(at, places, phase)))


@dataclass(frozen=True, eq=False)
class Plant:
    """Plant for which a controller is tuned.

    Parameters
    ----------
    system : LinearSystem or FrequencyData
    delay : float
        s, in series.

    Raises
    ------
    InvalidInput
        The system is unstable, or the delay negative or not finite.
    """

    system: LinearSystem | FrequencyData
    delay: float = 0.0
    integrators: int = field(init=False)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.delay) and self.delay >= 0.0):
            raise InvalidInput(f"delay = {self.delay!r} s: must be finite and 0 or more")
        object.__setattr__(self, "integrators", _integrators(self.system))

    def response(self, omega: ArrayLike) -> Complex:
        """G(j omega) with the delay."""
        w = np.asarray(omega, dtype=float)
        return np.asarray(self.system.response(w) * np.exp(-1j * w * self.delay))

    def search_frequencies(self, wc: float) -> Array:
        """(N,) rad/s, ascending: frequencies that resolve a loop that crosses over at wc."""
        if isinstance(self.system, FrequencyData):
            omega = np.asarray(self.system.omega, dtype=float)
            count = int(_PER_DECADE * math.log10(omega[-1] / omega[0])) + 2
            return np.unique(np.concatenate([omega, np.geomspace(omega[0], omega[-1], count)]))
        turns = np.concatenate([_turns(self.system.denominator), _turns(self.system.numerator)])
        sizes = np.append(np.abs(turns), wc)
        low, high = 1e-4 * float(np.min(sizes)), 1e3 * wc
        grid = np.geomspace(low, high, int(_PER_DECADE * math.log10(high / low)))
        near = np.geomspace(0.1 * wc, 10.0 * wc, 8 * _PER_DECADE)
        width = np.maximum(np.abs(turns.real), 1e-6 * np.abs(turns))
        clusters = (np.abs(turns.imag) + width * _CLUSTER[:, None]).ravel()
        return np.unique(np.concatenate([grid, near, clusters[(clusters > low) & (clusters < high)]]))


def _turns(p: Array) -> Complex:
    """Roots of a polynomial that are not at 0."""
    nonzero = np.flatnonzero(p)
    return np.asarray(poly.polyroots(p[nonzero[0] : nonzero[-1] + 1]), dtype=complex)


def _integrators(system: LinearSystem | FrequencyData) -> int:
    """Poles at 0; refuses a plant with poles to their right."""
    if isinstance(system, FrequencyData):
        if isinstance(system.integrators, bool) or not isinstance(system.integrators, int) or system.integrators < 0:
            raise InvalidInput(f"frequency data: integrators = {system.integrators!r} must be an integer of 0 or more")
        return system.integrators
    poles = _turns(system.denominator)
    worst = poles[np.argmax(poles.real)] if poles.size else complex(-1.0)
    if worst.real >= -_AXIS * abs(worst):
        where = f"{worst.real:.3g}{worst.imag:+.3g}j"
        raise InvalidInput(
            f"the plant is not stable: it has a pole at {where} 1/s; apart from integrators all must lie left"
        )
    return int(np.flatnonzero(system.denominator)[0]) - int(np.flatnonzero(system.numerator)[0])


def nyquist_stable(loops: Complex, integrators: int) -> Array:
    """Decide which closed loops are stable, by Nyquist's criterion.

    Parameters
    ----------
    loops : (M, N) complex array
        L(j omega) of M loops at N rising frequencies, close enough that 1 + L never turns by half a circle between two.
    integrators : int
        Poles of L at 0; the others are stable.

    Returns
    -------
    (M,) boolean array
        1 + L begins a quarter turn per integrator below the real axis and must come back to it without another turn.
    """
    phase = np.angle(1.0 + loops)
    begin = phase[:, 0] + 0.5 * np.pi * integrators
    begin = (begin + np.pi) % (2.0 * np.pi) - np.pi
    turned = np.sum((np.diff(phase, axis=1) + np.pi) % (2.0 * np.pi) - np.pi, axis=1)
    end = begin - 0.5 * np.pi * integrators + turned
    return np.asarray((np.abs(begin) < 0.5 * np.pi) & (np.abs(end) < 0.5 * np.pi))
