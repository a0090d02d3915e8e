"""Frequency responses of many systems at many points, by their Schur forms."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.plant.linear import Complex
from servotwin.plant.signals import Array


class SchurForms(NamedTuple):
    """Triangular A (P, n, n) of balanced systems, with B and C (P, n) in its states."""

    A: Complex
    B: Complex
    C: Complex


def schur_forms(A: Array, B: Array, C: Array) -> SchurForms:
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
def response_at(forms: SchurForms, direct: float, points: Complex) -> Complex:
    """(P, K) C (s - A)^-1 B + D at (P, K) points, by back substitution in the Schur form."""
    states = np.zeros((forms.A.shape[1], *points.shape), dtype=np.complex128)
    value = np.full(points.shape, direct, dtype=np.complex128)
    for i in range(len(states) - 1, -1, -1):
        driven = np.einsum("pj,jpk->pk", forms.A[:, i, i + 1 :], states[i + 1 :])
        states[i] = (forms.B[:, i, None] + driven) / (points - forms.A[:, i, i, None])
        value += forms.C[:, i, None] * states[i]
    return value


def response_of(A: Array, B: Array, C: Array, D: float, points: Complex) -> Complex:
    """(1, K) response of one system of a single input at (1, K) points."""
    return response_at(schur_forms(A[None], B[None], C[None]), D, points)
