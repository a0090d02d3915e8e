"""Small linear least squares, and projection of nuisances out of a residual.

Parameters that enter a residual linearly and are of no interest are projected out: no search over them, no samples
discarded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.compiled import bare, summed
from servotwin.plant.signals import Array

Flags: TypeAlias = NDArray[np.bool_]

_NOTHING_LEFT = 1e-7  # of a column's length: what the others leave of it below this is rounding
_DEPENDENT_EIGENVALUE = 1e-11  # of the largest eigenvalue of the columns scaled to one


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Coefficients x (k,) that make the residual target - x columns small.

    Attributes
    ----------
    coefficients : (k,) array
        The shortest, where columns depend on one another.
    root : (d, k) array
        root' root is the inverse of the information: d independent directions, one standard deviation each for white
        noise of variance 1.
    undetermined : (k,) array of bool
        Coefficients that were left out, because their columns depend on earlier ones (`independent_least_squares`).
    """

    coefficients: Array
    root: Array
    undetermined: Flags

    @property
    def deviations(self) -> Array:
        """(k,) standard deviations of the coefficients for white noise of variance 1."""
        return np.asarray(np.sqrt(np.sum(self.root * self.root, axis=0)))

    def deviation(self, weights: Array) -> float:
        """Standard deviation of a weighted sum of coefficients in white noise of variance 1; inf: undetermined."""
        return math.inf if np.any(weights[self.undetermined]) else float(np.linalg.norm(self.root @ weights))


def least_squares(columns: Array, target: Array) -> LeastSquares:
    """Fit the rows of `columns` (k, m) to `target` (m,)."""
    products, root = columns @ columns.T, np.zeros((len(columns), len(columns)))
    if not invert_triangle(products, root):
        root = _root_of_dependent(products)
    return LeastSquares(root.T @ (root @ (columns @ target)), root, np.zeros(len(columns), dtype=bool))


def _root_of_dependent(products: Array) -> Array:
    """`LeastSquares.root` of columns with these products (k, k), some of which depend on others."""
    size = np.sqrt(products.diagonal())
    size[size == 0.0] = 1.0
    # Columns of length one: the test for dependence must not depend on their units.
    values, vectors = np.linalg.eigh(products / (size[:, None] * size))
    good = values > _DEPENDENT_EIGENVALUE * values[-1]
    return np.asarray((vectors[:, good] / np.sqrt(values[good])).T / size)


def independent_least_squares(columns: Array, target: Array) -> LeastSquares:
    """Fit the rows of `columns` (k, m) to `target` (m,), without those that depend on the rows before them.

    Orthogonalisation detects dependence at 1e-7 of a column's length; `least_squares`, which squares the columns,
    detects it at 3e-6, whatever their order.
    """
    size = np.sqrt(np.sum(columns * columns, axis=1))
    size[size == 0.0] = 1.0
    scaled = columns / size[:, None]
    good = np.abs(np.diagonal(np.linalg.qr(scaled.T, mode="r"))) > _NOTHING_LEFT
    basis, triangle = np.linalg.qr(scaled[good].T)
    inverse = np.linalg.inv(triangle)
    coefficients, root = np.zeros(good.size), np.zeros((int(good.sum()), good.size))
    coefficients[good], root[:, good] = inverse @ (basis.T @ target), inverse.T
    return LeastSquares(coefficients / size, root / size, ~good)


_SINGULAR = 1e-7  # of a derivative's length: what is left of it below this is rounding
_DEPENDENT = 1e-9  # of its length: a column of which less is left adds nothing but rounding


def orthonormal(columns: Array, basis: Array | None = None) -> Array:
    """(r, n) orthonormal rows that span, with those of `basis`, what the rows of `columns` (k, n) span.

    Gram-Schmidt, each row twice; rows that depend on earlier ones are left out. `basis` (m, n) comes first in the
    result and is not changed.
    """
    known = 0 if basis is None else len(basis)
    rows = np.empty((known + len(columns), columns.shape[1]))
    if basis is not None:
        rows[:known] = basis
    return rows[: add_directions(rows, known, np.ascontiguousarray(columns), _DEPENDENT)]


def project_out(basis: Array, columns: Array) -> Array:
    """(k, n) what is left of the rows of `columns` (k, n) off the orthonormal rows of `basis` (r, n)."""
    left = columns.copy()
    remove_from_all(basis, left)
    return left


def spread(derivative: Array, others: Array, singular: float = _SINGULAR) -> float:
    """Standard deviation of a parameter in white noise of variance 1, `others` (k, m) being estimated beside it.

    The Schur complement of the information is the squared length of what is left of its derivative (m,) off all
    others; when no more than the part `singular` is left, nothing shows the parameter: inf.
    """
    left = project_out(orthonormal(others), derivative[None])[0]
    size = math.sqrt(float(left @ left))
    return 1.0 / size if size > singular * math.sqrt(float(derivative @ derivative)) else math.inf


@summed
def inner(one: Array, other: Array) -> float:
    """Inner product of two rows (n,), in any order."""
    total = 0.0
    for i in range(other.size):
        total += one[i] * other[i]
    return total


@bare
def invert_triangle(products: Array, root: Array) -> bool:
    """`LeastSquares.root` as the inverse of a triangle (Cholesky's) into `root` (k, k), which is zero.

    False where some columns with these products (k, k) may depend on others, by the test of the eigenvalues: the least
    is at least one over the sum of the root's squares, and the largest at most k, for columns of length one.
    """
    count, total = len(products), 0.0
    for i in range(count):
        row = root[i]
        left = products[i, i]
        for j in range(i):
            share = 0.0
            for k in range(j + 1):
                share += root[j, k] * products[i, k]
            left -= share * share
            for k in range(j + 1):
                row[k] -= share * root[j, k]
        if not left > 0.0:
            return False
        length = np.sqrt(left)
        row[i] = 1.0
        for k in range(i + 1):
            row[k] /= length
            total += row[k] * row[k] * products[k, k]
    return total * count * _DEPENDENT_EIGENVALUE < 1.0


@bare
def remove(rows: Array, known: int, column: Array) -> None:
    """Take off a column (n,) its parts along the first `known` orthonormal rows, one after the other."""
    for k in range(known):
        row = rows[k]
        share = inner(row, column)
        for i in range(column.size):
            column[i] -= share * row[i]


@bare
def add_direction(rows: Array, known: int, column: Array, dependent: float) -> bool:
    """Put what is new in a column, normalised, into row `known`; False when nothing is."""
    row = rows[known]
    for i in range(row.size):
        row[i] = column[i]
    before = inner(row, row)
    remove(rows, known, row)
    remove(rows, known, row)
    after = inner(row, row)
    if not after > dependent * dependent * before:
        return False
    length = np.sqrt(after)
    for i in range(row.size):
        row[i] /= length
    return True


@bare
def add_directions(rows: Array, known: int, columns: Array, dependent: float) -> int:
    """Put what is new in some columns (k, n) into the rows from `known` on; return the number of rows then."""
    for k in range(len(columns)):
        if add_direction(rows, known, columns[k], dependent):
            known += 1
    return known


@bare
def remove_from_all(basis: Array, columns: Array) -> None:
    """Take off some columns (k, n) their parts along orthonormal rows."""
    for k in range(len(columns)):
        remove(basis, len(basis), columns[k])
