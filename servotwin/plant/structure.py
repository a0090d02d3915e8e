"""The chain of masses on springs and dampers that the lead screw drives (Eqs 9-13, any n >= 1, unequal masses too).

Mass 1 hangs on the ground by spring 1 and damper 1, mass i on mass i - 1 by spring i and damper i (Eq 9). The
screw's elongation d = p theta_d moves mass 1, either rigidly (k_d infinite, Eq 10) or through the spring k_d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotwin.plant.linear import minus, product, times
from servotwin.plant.signals import Array


class Structure(NamedTuple):
    """Parameters of the chain: (n,) masses (kg), stiffnesses (N/m), dampings (N s/m), stiffness (N/m) and damping
    (N s/m) of the screw."""

    m: Array
    k: Array
    c: Array
    k_d: float
    c_d: float = 0.0


@dataclass(frozen=True, eq=False)
class Chain:
    """x' = A x + B_position d + B_velocity d', the n positions q = C x + D d, with d = p theta_d.

    Chains of one structure may share one of these: A, B_position, B_velocity, reaction and A_open have a leading axis
    then.

    Attributes
    ----------
    A : (N, N) array
        Rigid screw: N = 2 (n - 1), x = [q_2..q_n, v_2..v_n]. Finite k_d: N = 2 n, x = [q_1..q_n, v_1..v_n].
    B_position, B_velocity : (N,) arrays
        Input columns of d (m) and d' (m/s); with finite k_d the second is zero.
    C : (n, N) array
    D : (n,) array
        All positions; with a rigid screw q_1 = d.
    reaction : (N,) array
    reaction_position : float, or (P, 1) array
        Force on the screw, N: F = reaction x + reaction_position d + reaction_velocity d', that is k_d (d - q_1)
        + c_d (d' - v_1). Zero with a rigid screw, whose load does not act back (the paper's first assumption).
    reaction_velocity : float, or (P, 1) array
        c_d.
    A_open : (N, N) array
        A of the chain without the screw's force; A itself with a rigid screw.
    """

    A: Array
    B_position: Array
    B_velocity: Array
    C: Array
    D: Array
    reaction: Array
    reaction_position: float | Array
    reaction_velocity: float | Array
    A_open: Array

    @property
    def C_last(self) -> Array:
        """(N,) row of the last mass's position, the controlled one."""
        return np.asarray(self.C[-1])

    def equilibrium(self, d: float | Array) -> Array:
        """(N,) state at rest for a constant elongation d (m); of many chains (P, N) for (P, 1) of them."""
        return np.asarray(np.linalg.solve(self.A, (-self.B_position * d)[..., None])[..., 0])


def chain(m: Array, k: Array, c: Array, k_d: float | Array = math.inf, c_d: float | Array = 0.0) -> Chain:
    """The chain's matrices.

    Parameters
    ----------
    m, k, c : (n,) or (P, n) arrays
        kg, N/m, N s/m, from the screw's end outwards; the matrices of P chains have a leading axis. With a rigid screw
        the first of each is inert.
    k_d : float or (P,) array
        N/m, stiffness between screw and mass 1; infinite means that mass 1 follows the screw.
    c_d : float or (P,) array
        N s/m, damping beside that stiffness.
    """
    return _prescribed(m, k, c) if np.isinf(k_d).all() else _elastic(m, k, c, k_d, c_d)


def _prescribed(m: Array, k: Array, c: Array) -> Chain:
    """Eq 10: q_1 = d is moved to the right-hand side."""
    lead, free = m.shape[:-1], m.shape[-1] - 1
    A = _first_order(m[..., 1:], tridiagonal(k)[..., 1:, 1:], tridiagonal(c)[..., 1:, 1:])
    B_position, B_velocity, zero = np.zeros((3, *lead, 2 * free))
    if free:
        B_position[..., free] = k[..., 1] / m[..., 1]
        B_velocity[..., free] = c[..., 1] / m[..., 1]
    C = np.vstack([np.zeros(2 * free), np.eye(free, 2 * free)])
    return Chain(A, B_position, B_velocity, C, np.eye(free + 1)[0], zero, 0.0, 0.0, A)


def _elastic(m: Array, k: Array, c: Array, k_d: float | Array, c_d: float | Array) -> Chain:
    """Eq 9 with the force k_d (d - q_1) + c_d (d' - v_1) on mass 1."""
    n = m.shape[-1]
    stiffness, damping = tridiagonal(k), tridiagonal(c)
    A_open = _first_order(m, stiffness, damping)
    stiffness[..., 0, 0] += k_d
    damping[..., 0, 0] += c_d
    B_position, B_velocity, reaction = np.zeros((3, *m.shape[:-1], 2 * n))
    B_position[..., n], B_velocity[..., n] = k_d / m[..., 0], c_d / m[..., 0]
    reaction[..., 0], reaction[..., n] = -k_d, -c_d
    A = _first_order(m, stiffness, damping)
    # A column beside the rows that it multiplies.
    stiff, damped = (each if np.ndim(each) == 0 else np.asarray(each)[..., None] for each in (k_d, c_d))
    return Chain(A, B_position, B_velocity, np.eye(n, 2 * n), np.zeros(n), reaction, stiff, damped, A_open)


def tridiagonal(k: Array) -> Array:
    """(..., n, n) stiffness (or damping) matrix of Eq 9 for the elements k (..., n)."""
    n, ahead = k.shape[-1], k[..., 1:]
    result = np.zeros((*k.shape[:-1], n * n))
    # Every n + 1 elements on is the next one of a diagonal.
    result[..., :: n + 1] = k
    result[..., : n * (n - 1) : n + 1] += ahead
    result[..., 1 : n * (n - 1) : n + 1] = result[..., n :: n + 1] = -ahead
    return result.reshape((*k.shape, n))


def _first_order(m: Array, stiffness: Array, damping: Array) -> Array:
    """(2 n, 2 n) matrix of m q'' + damping q' + stiffness q = 0 for x = [q, q']."""
    n = m.shape[-1]
    result = np.zeros((*m.shape[:-1], 2 * n, 2 * n))
    result[..., :n, n:] = np.eye(n)
    masses = m[..., :, None]
    result[..., n:, :n], result[..., n:, n:] = -stiffness / masses, -damping / masses
    return result


@np.errstate(over="ignore", invalid="ignore")  # a chain of a hundred masses overflows: see LinearSystem.response
def transfer(m: Array, k: Array, c: Array, k_d: float = math.inf, c_d: float = 0.0) -> tuple[Array, Array, Array]:
    """Polynomials in s, ascending: (numerator of q_n / d, denominator, the same determinant without mass 1).

    The dynamic stiffness is tridiagonal, so its determinant is a continuant and the cofactor of q_n is the product
    of the couplings c_i s + k_i (Eq 13 for n = 3); nothing is inverted.
    """
    couplings = product(np.array([k[i], c[i]]) for i in range(1, m.size))
    inner = _determinant(m[1:], k[1:], c[1:])
    if math.isinf(k_d):
        return couplings, inner, inner
    # The spring k_d of the screw hangs mass 1 on one more support.
    extra, damped = k.copy(), c.copy()
    extra[0] += k_d
    damped[0] += c_d
    screw = np.array([k_d, c_d]) if c_d else np.array([k_d])
    return times(screw, couplings), _determinant(m, extra, damped), inner


def _determinant(m: Array, k: Array, c: Array) -> Array:
    """det(M s^2 + C s + K) of a chain, by the three-term recursion from its free end; 1 for none."""
    if m.size == 0:
        return np.array([1.0])
    beyond, here = np.array([1.0]), np.array([k[-1], c[-1], m[-1]])
    for i in range(m.size - 2, -1, -1):
        diagonal = np.array([k[i] + k[i + 1], c[i] + c[i + 1], m[i]])
        coupling = np.array([k[i + 1], c[i + 1]])
        square = product([coupling, coupling, beyond])
        beyond, here = here, minus(times(diagonal, here), square)
    return here
