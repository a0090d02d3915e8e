"""Linear single-input single-output systems, in two forms: state space for time, polynomials for frequency.

Both forms are built side by side from physical parameters, so neither suffers from a conversion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput
from servotwin.plant.signals import Array
from servotwin.runtime.extras import require

Complex = NDArray[np.complex128]
# Rounding error of a fraction of polynomials, relative, beyond which the response is computed from the matrices: the
# power basis loses about a factor of six per mass of a chain.
_ROUNDED = 1e-9


def times(first: Array, second: Array) -> Array:
    """Product of two polynomials with ascending coefficients."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(poly.polymul(first, second), dtype=float)


def plus(first: Array, second: Array) -> Array:
    """Sum of two polynomials."""
    return np.asarray(poly.polyadd(first, second), dtype=float)


def minus(first: Array, second: Array) -> Array:
    """Difference of two polynomials."""
    with np.errstate(invalid="ignore"):
        return np.asarray(poly.polysub(first, second), dtype=float)


def product(factors: Iterable[Array]) -> Array:
    """Product of any number of polynomials."""
    return reduce(times, factors, np.array([1.0]))


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """y = G(s) u, G = numerator / denominator = C (s - A)^-1 B + D.

    Attributes
    ----------
    A, B, C, D : (N, N), (N,), (N,) arrays and float
    numerator, denominator : arrays
        Coefficients in ascending powers of s; common factors are not cancelled.
    """

    A: Array
    B: Array
    C: Array
    D: float
    numerator: Array
    denominator: Array

    def response(self, omega: ArrayLike) -> Complex:
        """G(j omega) for omega in rad/s; from the matrices where rounding spoils the polynomials."""
        s = 1j * np.asarray(omega, dtype=float)
        with np.errstate(all="ignore"):
            above, below = poly.polyval(s, self.numerator), poly.polyval(s, self.denominator)
            values = np.asarray(above / below, dtype=complex)
            sizes = [poly.polyval(np.abs(s), np.abs(p)) for p in (self.numerator, self.denominator)]
            error = np.finfo(float).eps * (sizes[0] / np.abs(above) + sizes[1] / np.abs(below))
        # Not `error >= _ROUNDED`: the error of an overflow is NaN, which compares false.
        spoilt = ~(error < _ROUNDED) & ((s != 0.0) | (not self._has_polynomials))
        if spoilt.any():
            values = values.copy()
            values[spoilt] = self._response_of_states(s[spoilt])
        return values

    @cached_property
    def _has_polynomials(self) -> bool:
        """False where a chain is so long that its coefficients overflow."""
        return bool(np.isfinite(self.numerator).all() and np.isfinite(self.denominator).all())

    @np.errstate(all="ignore")
    def _response_of_states(self, s: Complex) -> Complex:
        """C (s - A)^-1 B + D for (K,) s, by back substitution in the Schur form."""
        triangular, entries, exits = self._schur
        states = np.zeros((triangular.shape[0], s.size), dtype=complex)
        for i in range(len(states) - 1, -1, -1):
            states[i] = (entries[i] + triangular[i, i + 1 :] @ states[i + 1 :]) / (s - triangular[i, i])
        return np.asarray(exits @ states + self.D)

    @cached_property
    def _schur(self) -> tuple[Complex, Complex, Complex]:
        """Schur form of the balanced A, with B and C in its states."""
        from scipy.linalg import matrix_balance, schur

        # Balanced, because the entries of a stiff chain differ by many powers of ten.
        balanced, scaling = matrix_balance(self.A)
        triangular, unitary = schur(balanced, output="complex")
        # One number in each row and column, however far apart they are.
        back = np.divide(1.0, scaling.T, out=np.zeros_like(scaling), where=scaling.T != 0.0)
        return triangular, unitary.conj().T @ (back @ self.B), (self.C @ scaling) @ unitary

    def zeros(self) -> Complex:
        """(K,) zeros, 1/s, the roots of the numerator; none where it overflows."""
        if not self._has_polynomials:
            return np.zeros(0, dtype=complex)
        # polyroots divides by the leading coefficient, which must not be zero.
        nonzero = np.flatnonzero(self.numerator)
        return np.asarray(poly.polyroots(self.numerator[: nonzero[-1] + 1] if nonzero.size else [1.0]), dtype=complex)

    def asymptotic_crossovers(self) -> Array:
        """(K,) rad/s at which the asymptotes of abs(G) at low and at high frequency are one."""
        if not self._has_polynomials:
            return np.zeros(0)
        above, below = np.flatnonzero(self.numerator), np.flatnonzero(self.denominator)
        crossovers = []
        for end in (0, -1) if above.size else ():
            order = int(below[end] - above[end])
            if order != 0:
                crossovers.append(abs(self.numerator[above[end]] / self.denominator[below[end]]) ** (1.0 / order))
        return np.array([omega for omega in crossovers if 0.0 < omega < np.inf])

    def poles(self) -> Complex:
        """(N,) eigenvalues of A, 1/s."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=complex)

    def is_stable(self) -> bool:
        """True when every pole lies left of the imaginary axis."""
        return self.A.size == 0 or bool(np.max(self.poles().real) < 0.0)

    def step(self, time: ArrayLike) -> Array:
        """(n,) response at equally spaced times (s, from 0) to a unit step, exact by a matrix exponential (Fig 5a)."""
        time = np.asarray(time, dtype=float)
        advance, drive = zero_order_hold(self.A, self.B, float(time[1] - time[0]))
        states = np.zeros((time.size, self.B.size))
        for i in range(1, time.size):
            states[i] = advance @ states[i - 1] + drive
        return np.asarray(states @ self.C + self.D)

    def to_control(self) -> Any:
        """The same system as a python-control StateSpace.

        Raises
        ------
        InvalidInput
            python-control is not installed.
        """
        control = require("control", "a python-control system")
        return control.ss(self.A, self.B[:, None], self.C[None, :], [[self.D]])


def zero_order_hold(A: Array, B: Array, step: float) -> tuple[Array, Array]:
    """(A_d, B_d) of x' = A x + B u over `step` seconds of constant u (zero-order hold), by a matrix exponential."""
    advance, drive = zero_order_holds(A[None], B[None], step)
    return advance[0], drive[0]


def zero_order_holds(A: Array, B: Array, step: float) -> tuple[Array, Array]:
    """`zero_order_hold` of (P, n, n) and (P, n) systems."""
    from scipy.linalg import expm

    size = B.shape[1]
    flow = np.zeros((len(A), size + 1, size + 1))
    flow[:, :size, :size], flow[:, :size, size] = A, B
    advance = expm(flow * step)
    return advance[:, :size, :size], advance[:, :size, size]


def gain(value: float) -> LinearSystem:
    """A constant gain."""
    return LinearSystem(np.zeros((0, 0)), np.zeros(0), np.zeros(0), value, np.array([value]), np.array([1.0]))


def lag(value: float, time: float) -> LinearSystem:
    """value / (time s + 1)."""
    A, B, C = np.array([[-1.0 / time]]), np.array([1.0 / time]), np.array([value])
    return LinearSystem(A, B, C, 0.0, np.array([value]), np.array([1.0, time]))


def integrator(value: float) -> LinearSystem:
    """value / s."""
    return LinearSystem(
        np.zeros((1, 1)), np.array([value]), np.array([1.0]), 0.0, np.array([value]), np.array([0.0, 1.0])
    )


def series(first: LinearSystem, second: LinearSystem) -> LinearSystem:
    """second(first(u))."""
    n, m = first.B.size, second.B.size
    A = np.block([[first.A, np.zeros((n, m))], [np.outer(second.B, first.C), second.A]])
    B = np.concatenate([first.B, second.B * first.D])
    C = np.concatenate([second.D * first.C, second.C])
    numerator = times(first.numerator, second.numerator)
    denominator = times(first.denominator, second.denominator)
    return LinearSystem(A, B, C, second.D * first.D, numerator, denominator)


def parallel(first: LinearSystem, second: LinearSystem) -> LinearSystem:
    """first(u) + second(u)."""
    n, m = first.B.size, second.B.size
    A = np.block([[first.A, np.zeros((n, m))], [np.zeros((m, n)), second.A]])
    numerator = plus(times(first.numerator, second.denominator), times(second.numerator, first.denominator))
    return LinearSystem(
        A,
        np.concatenate([first.B, second.B]),
        np.concatenate([first.C, second.C]),
        first.D + second.D,
        numerator,
        times(first.denominator, second.denominator),
    )


def feedback(forward: LinearSystem, back: LinearSystem) -> LinearSystem:
    """forward / (1 + forward back), for a loop without a direct path (forward.D = 0)."""
    if forward.D != 0.0:
        raise InvalidInput("feedback: the forward path must be strictly proper")
    n, m = forward.B.size, back.B.size
    A = np.block([[forward.A, np.zeros((n, m))], [np.zeros((m, n)), back.A]])
    B = np.concatenate([forward.B, np.zeros(m)])
    C = np.concatenate([forward.C, np.zeros(m)])
    A[:n] -= np.outer(forward.B, np.concatenate([back.D * forward.C, back.C]))
    A[n:] += np.outer(back.B, C)
    denominator = plus(times(forward.denominator, back.denominator), times(forward.numerator, back.numerator))
    return LinearSystem(A, B, C, 0.0, times(forward.numerator, back.denominator), denominator)


def realised(numerator: Array, denominator: Array) -> LinearSystem:
    """A proper fraction of polynomials, ascending powers of s, in controllable form."""
    order = denominator.size - 1
    above = np.append(numerator, np.zeros(denominator.size - numerator.size))
    direct = float(above[-1] / denominator[-1])
    rest = (above - direct * denominator)[:-1] / denominator[-1]
    A = np.eye(order, k=1)
    A[-1:] = -denominator[:-1] / denominator[-1]
    B = np.eye(order)[-1] if order else np.zeros(0)
    return LinearSystem(A, B, rest, direct, numerator, denominator)
