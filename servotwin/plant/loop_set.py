"""Margins of one law on many plants at once, without a gap: continuous, or sampled at the law's own rate with a delay.

A sampled plant is the exact zero-order hold, and the law is the edge's own tick. Both kinds are evaluated in the same
way: the points on the stability boundary are s = j omega, or the delta operator's (exp(j omega T) - 1) / T, in which a
fast rate loses no digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.control.controller import Controller
from servotwin.plant.linear import Complex, LinearSystem, zero_order_holds
from servotwin.plant.loop import StateMatrices, continuous_law, sampled_law
from servotwin.plant.signals import Array

_PER_DECADE = 60
# Beyond the outermost corner of a plant a loop is its asymptote; it crosses over within this factor of the corners.
_BEYOND = 1e2
# Frequencies about each pole, in its half widths.
_ABOUT = np.array([-8.0, -4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0, 8.0])
_NARROWEST = 1e-6
_DISTINCT = 1e-9
_AT_ONCE = 700.0
# The least value between two frequencies is searched for by zooming in.
_ZOOMS, _INSIDE = 2, np.linspace(0.0, 1.0, 17)


class SetMargins(NamedTuple):
    """Margins of one law on each of P plants, (P,) arrays.

    Attributes
    ----------
    stable : array of bool
        Stability of the closed loop; the other margins mean nothing without it.
    Ms : array
        Largest abs(1 / (1 + L)); inf where the loop is not stable.
    gain_margin : array
        Least factor, up or down, on the loop gain that reaches the stability boundary; inf: none does.
    phase_margin, delay_margin : array
        rad, either way, and s of additional delay at the worst crossover; pi and inf where there is none.
    decay : array
        1/s, rate at which the slowest closed-loop mode decays; negative: it grows.
    passivity : array
        Least 1 + Re L(j omega). Above 0, the circle criterion excludes a limit cycle in a gap of any width.
    """

    stable: NDArray[np.bool_]
    Ms: Array
    gain_margin: Array
    phase_margin: Array
    delay_margin: Array
    decay: Array
    passivity: Array


@dataclass(frozen=True, eq=False)
class PlantSet:
    """Linear plants of one structure, as a law with this rate meets them.

    Attributes
    ----------
    A, B, C : (P, n, n), (P, n), (P, n) arrays
        In continuous time, or of the delta operator at `rate`.
    rate : float or None
        Hz; None: continuous.
    """

    A: Array
    B: Array
    C: Array
    rate: float | None

    @staticmethod
    def of(plants: Sequence[LinearSystem], rate: float | None) -> PlantSet:
        """Discretise plants, by zero-order hold where there is a rate."""
        A, B, C = (np.array([getattr(plant, name) for plant in plants]) for name in ("A", "B", "C"))
        if rate is not None:
            A, B = zero_order_holds(A, B, 1.0 / rate)
            A, B = rate * (A - np.eye(B.shape[1])), rate * B
        return PlantSet(A, B, C, rate)

    @cached_property
    def omega(self) -> Array:
        """(P, F) rad/s, ascending: frequencies that resolve the poles of each plant."""
        poles = self._frequencies(_eigenvalues(self.A))
        sizes = np.abs(poles)
        # The integrator's pole is zero only to within rounding.
        real = sizes > 1e-9 * sizes.max(axis=1, keepdims=True)
        low, high = float(sizes[real].min()) / _BEYOND, float(sizes[real].max()) * _BEYOND
        high = high if self.rate is None else math.pi * self.rate
        low = min(low, 1e-3 * high)
        common = np.geomspace(low, high, int(_PER_DECADE * math.log10(high / low)) + 2)
        about = np.clip(_about(poles), low, high)
        return np.sort(np.concatenate([np.broadcast_to(common, (len(poles), common.size)), about], axis=1), axis=1)

    @cached_property
    def response(self) -> Complex:
        """(P, F) response at `omega`."""
        return self.at(self.omega)

    def at(self, omega: Array) -> Complex:
        """(P, K) response at (P, K) frequencies, rad/s."""
        return _response(self._schur, 0.0, self.points(omega))

    @cached_property
    def _schur(self) -> SchurForms:
        return _schur_forms(self.A, self.B, self.C)

    def points(self, omega: Array) -> Complex:
        """Points of the stability boundary for frequencies in rad/s."""
        if self.rate is None:
            return np.asarray(1j * omega, dtype=np.complex128)
        return np.asarray(self.rate * np.expm1(1j * np.asarray(omega) / self.rate), dtype=np.complex128)

    def loop(self, law: Controller, delay: int, omega: Array) -> Complex:
        """(P, K) response of the open loop at (P, K) frequencies, rad/s."""
        return self._loop(self._matrices(law), delay, omega)

    def _loop(self, law: StateMatrices, delay: int, omega: Array) -> Complex:
        return np.asarray(self.at(omega) * self._law_response(law, delay, omega))

    def _matrices(self, law: Controller) -> StateMatrices:
        return continuous_law(law) if self.rate is None else sampled_law(law)

    def peaks(self, law: Controller, delay: int = 0) -> Array:
        """(P,) sensitivity peaks on the stored frequencies: at most what `margins` finds, and much cheaper."""
        loop = self.response * self._law_response(self._matrices(law), delay, self.omega)
        return np.asarray(np.max(1.0 / np.abs(1.0 + loop), axis=1))

    def decays(self, law: Controller, delay: int = 0) -> Array:
        """(P,) 1/s, rate at which the slowest closed-loop mode decays; negative: it grows."""
        poles = _eigenvalues(self._closed(self._matrices(law), delay))
        return np.asarray(-self._frequencies(poles).real.max(axis=1))

    def margins(self, law: Controller, delay: int = 0) -> SetMargins:
        """Margins of the loop with a law.

        Parameters
        ----------
        law : Controller
            With the sample rate of this set.
        delay : int
            Whole samples between a measurement and its voltage; 0 for a continuous law.
        """
        matrices = self._matrices(law)
        poles = _eigenvalues(self._closed(matrices, delay))
        growth = self._frequencies(poles).real.max(axis=1)
        # Closed-loop resonances are not those of the plant alone.
        extra = _about(self._frequencies(poles))
        extra = np.clip(extra, self.omega[:, :1], self.omega[:, -1:])
        omega = np.concatenate([self.omega, extra], axis=1)
        order = np.argsort(omega, axis=1, kind="stable")
        omega = np.take_along_axis(omega, order, axis=1)
        plant = np.take_along_axis(np.concatenate([self.response, self.at(extra)], axis=1), order, axis=1)
        loop = plant * self._law_response(matrices, delay, omega)
        stable = growth < 0.0

        def value(omega: Array) -> Complex:
            return self._loop(matrices, delay, omega)

        gain, phase, late = _distances(omega, loop, value)
        closest = _least(omega, np.abs(1.0 + loop), lambda w: np.abs(1.0 + value(w)))
        peak = np.where(stable, 1.0 / closest, np.inf)
        passivity = 1.0 + _least(omega, loop.real, lambda w: value(w).real)
        return SetMargins(stable, peak, gain, phase, late, -growth, passivity)

    def _frequencies(self, poles: Complex) -> Complex:
        """Poles in 1/s."""
        if self.rate is None:
            return np.asarray(poles)
        with np.errstate(divide="ignore"):
            logarithm = np.log1p(poles / self.rate)
        # A pole z = 0 decays at once; the clip keeps its infinity out of the arithmetic.
        return np.asarray(self.rate * (np.maximum(logarithm.real, -_AT_ONCE) + 1j * logarithm.imag))

    def _law_response(self, law: StateMatrices, delay: int, omega: Array) -> Complex:
        """Response of law and delay from measurement to minus the voltage."""
        A, B, C, D = law
        if self.rate is not None:
            A, B = self.rate * (A - np.eye(len(A))), self.rate * B
        points = self.points(omega)
        value = _response(_schur_forms(A[None], B[None], C[None]), D, points.reshape(1, -1)).reshape(omega.shape)
        return value if self.rate is None else np.asarray(value * np.exp(-1j * delay * omega / self.rate))

    def _closed(self, law: StateMatrices, delay: int) -> Array:
        """(P, N, N) closed loop of plant, law and delayed voltages; the delta operator's where there is a rate."""
        A, B, C, D = law
        if self.rate is not None:
            A, B = self.rate * (A - np.eye(len(A))), self.rate * B
        n, k = self.B.shape[1], len(A)
        closed = np.zeros((len(self.A), n + k + delay, n + k + delay))
        closed[:, :n, :n] = self.A
        closed[:, n : n + k, n : n + k] = A
        closed[:, n : n + k, :n] = B[:, None] * self.C[:, None, :]
        output = np.zeros((len(self.A), n + k + delay))
        output[:, :n], output[:, n : n + k] = -D * self.C, -C
        if delay == 0:
            closed[:, :n] += self.B[:, :, None] * output[:, None, :]
            return closed
        assert self.rate is not None
        closed[:, :n, -1] += self.B
        # Shifts z x = y become (y - x) rate.
        line = np.arange(n + k, n + k + delay)
        closed[:, line, line] = -self.rate
        closed[:, line[1:], line[:-1]] = self.rate
        closed[:, line[0]] += self.rate * output
        return closed


class SchurForms(NamedTuple):
    """Triangular A (P, n, n) of balanced systems, with B and C (P, n) in its states."""

    A: Complex
    B: Complex
    C: Complex


def _schur_forms(A: Array, B: Array, C: Array) -> SchurForms:
    from scipy.linalg import matrix_balance, schur

    triangular, entries, exits = (np.empty(shape.shape, dtype=np.complex128) for shape in (A, B, C))
    for i in range(len(A)):
        if A.shape[1] == 0:
            continue
        balanced, scaling = matrix_balance(A[i])
        triangular[i], unitary = schur(balanced, output="complex")
        entries[i] = unitary.conj().T @ np.linalg.solve(scaling, B[i])
        exits[i] = C[i] @ scaling @ unitary
    return SchurForms(triangular, entries, exits)


@np.errstate(all="ignore")
def _response(forms: SchurForms, direct: float, points: Complex) -> Complex:
    """(P, K) C (s - A)^-1 B + D at (P, K) points, by back substitution in the Schur form."""
    states = np.zeros((forms.A.shape[1], *points.shape), dtype=np.complex128)
    value = np.full(points.shape, direct, dtype=np.complex128)
    for i in range(len(states) - 1, -1, -1):
        driven = np.einsum("pj,jpk->pk", forms.A[:, i, i + 1 :], states[i + 1 :])
        states[i] = (forms.B[:, i, None] + driven) / (points - forms.A[:, i, i, None])
        value += forms.C[:, i, None] * states[i]
    return value


def _eigenvalues(matrices: Array) -> Complex:
    return np.asarray(np.linalg.eigvals(matrices), dtype=np.complex128)


def _about(poles: Complex) -> Array:
    """(P, K) rad/s: frequencies about poles (1/s)."""
    poles = np.where(np.isfinite(poles), poles, 0.0)
    width = np.maximum(np.abs(poles.real), _NARROWEST * np.abs(poles))
    near = np.abs(poles.imag)[..., None] + width[..., None] * _ABOUT
    return np.asarray(np.abs(near).reshape(len(poles), -1))


def _least(omega: Array, values: Array, value: Callable[[Array], Array]) -> Array:
    """(P,) least values of a function of frequency: about the lowest of (P, F) samples the search is refined."""
    place = np.argmin(values, axis=1)[:, None]
    best, least = (np.take_along_axis(each, place, axis=1) for each in (omega, values))
    # Not simply the neighbours: equal frequencies may stand side by side.
    low = np.max(np.where(omega < best * (1.0 - _DISTINCT), omega, omega[:, :1]), axis=1, keepdims=True)
    high = np.min(np.where(omega > best * (1.0 + _DISTINCT), omega, omega[:, -1:]), axis=1, keepdims=True)
    least = least[:, 0]
    for _ in range(_ZOOMS):
        fine = low + (high - low) * _INSIDE
        found = value(fine)
        place = np.argmin(found, axis=1)[:, None]
        least = np.minimum(least, np.take_along_axis(found, place, axis=1)[:, 0])
        low, high = (np.take_along_axis(fine, np.clip(place + k, 0, fine.shape[1] - 1), axis=1) for k in (-1, 1))
    return np.asarray(least)


@np.errstate(all="ignore")
def _crossings(omega: Array, loop: Complex) -> Array:
    """(3, P, F - 1) gain margin, phase margin (rad) and delay margin (s) between each two frequencies; inf: no
    crossing."""
    size = np.log(np.abs(loop))
    # The angle of -L: pi plus the phase of L. Between two frequencies it turns by less than half a turn.
    before, turn = np.angle(-loop[:, :-1]), np.angle(loop[:, 1:] / loop[:, :-1])
    share = size[:, :-1] / (size[:, :-1] - size[:, 1:])
    crosses = (size[:, :-1] >= 0.0) != (size[:, 1:] >= 0.0)
    angle = before + share * turn
    phase = np.where(crosses, np.abs(np.mod(angle + np.pi, 2.0 * np.pi) - np.pi), np.inf)
    late = np.where(crosses, np.mod(angle, 2.0 * np.pi) / (omega[:, :-1] + share * np.diff(omega, axis=1)), np.inf)
    # Where L crosses the negative real axis the angle of -L crosses zero without a jump.
    crosses = (np.abs(before) < 0.5 * np.pi) & ((before >= 0.0) != (before + turn >= 0.0))
    share = np.where(crosses, before / -turn, 0.0)
    distance = np.abs(size[:, :-1] + share * np.diff(size, axis=1))
    return np.array([np.where(crosses, np.exp(np.minimum(distance, _AT_ONCE)), np.inf), phase, late])


def _distances(omega: Array, loop: Complex, value: Callable[[Array], Complex]) -> tuple[Array, Array, Array]:
    """(P,) least gain margins, phase margins (rad) and delay margins (s); the crossing of each is refined."""
    coarse = _crossings(omega, loop)
    least = []
    for kind, every in enumerate(coarse):
        place = np.argmin(every, axis=1)[:, None]
        low, high = (np.take_along_axis(omega, place + k, axis=1) for k in (0, 1))
        fine = low + (high - low) * _INSIDE
        refined = _crossings(fine, value(fine))[kind].min(axis=1)
        least.append(np.where(np.isfinite(refined), refined, every.min(axis=1)))
    return least[0], np.minimum(least[1], np.pi), least[2]
