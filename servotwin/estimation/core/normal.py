"""Small linear least-squares problems with columns of very different sizes, some of which may depend on others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.signals import Array

Flags: TypeAlias = NDArray[np.bool_]

_NOTHING_LEFT = 1e-7  # of a column's length: what the others leave of it below this is rounding
_DEPENDENT = 1e-11  # of the largest eigenvalue of the columns scaled to one


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
    size = np.sqrt(np.sum(columns * columns, axis=1))
    size[size == 0.0] = 1.0
    scaled = columns / size[:, None]
    values, vectors = np.linalg.eigh(scaled @ scaled.T)
    good = values > _DEPENDENT * values[-1]
    root = (vectors[:, good] / np.sqrt(values[good])).T
    return LeastSquares((root.T @ (root @ (scaled @ target))) / size, root / size, np.zeros(size.size, dtype=bool))


def independent_least_squares(columns: Array, target: Array) -> LeastSquares:
    """Fit the rows of `columns` (k, m) to `target` (m,), without those that depend on the rows before them.

    By orthogonalisation, which tells dependence at 1e-7 of a column's length; `least_squares`, which squares the
    columns, at 3e-6 and without regard to their order.
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
