"""Small linear least-squares problems with columns of very different sizes, some of which may depend on others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotwin.plant.signals import Array

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
    """

    coefficients: Array
    root: Array

    @property
    def deviations(self) -> Array:
        """(k,) standard deviations of the coefficients for white noise of variance 1."""
        return np.asarray(np.sqrt(np.sum(self.root * self.root, axis=0)))


def least_squares(columns: Array, target: Array) -> LeastSquares:
    """Fit the rows of `columns` (k, m) to `target` (m,)."""
    size = np.sqrt(np.sum(columns * columns, axis=1))
    size[size == 0.0] = 1.0
    scaled = columns / size[:, None]
    values, vectors = np.linalg.eigh(scaled @ scaled.T)
    good = values > _DEPENDENT * values[-1]
    root = (vectors[:, good] / np.sqrt(values[good])).T
    return LeastSquares((root.T @ (root @ (scaled @ target))) / size, root / size)
