"""Which parameters, or which of their products, a measurement determines: the information matrix taken apart.

Everything is by the logarithms of the parameters, so that a direction is a product of powers and its standard
deviation is relative. A direction without information is a product that no amount of such data can ever show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.projection import orthonormal, project_out
from servotwin.plant.signals import Array

_SINGULAR = 1e-9  # of the longest sensitivity: less is rounding
_ALONG = 1e-6  # share of a direction that may lie where nothing is known


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Singular value decomposition of the whitened sensitivities, nuisances taken off.

    Attributes
    ----------
    names : tuple of str
        P parameters.
    strengths : (P,) array
        Singular values, falling; the information matrix has their squares as eigenvalues. 0 where there is none.
    directions : (P, P) array
        Row i: exponents of the parameters in the product that belongs to strength i, of length 1.
    """

    names: tuple[str, ...]
    strengths: Array
    directions: Array

    @property
    def rank(self) -> int:
        """How many independent products of the parameters can be identified at all."""
        return int(np.count_nonzero(self.strengths))

    @property
    def information(self) -> Array:
        """(P, P) Fisher information of the logarithms."""
        return np.asarray(self.directions.T @ np.diag(self.strengths**2) @ self.directions)

    @property
    def hidden(self) -> Array:
        """(P - rank, P) orthonormal exponents of the products that nothing shows: the null space."""
        return self.directions[self.rank :]

    def relative_std(self, exponents: Mapping[str, float]) -> float:
        """Standard deviation of the logarithm of a product of powers; inf where the data do not determine it.

        Raises
        ------
        InvalidInput
            A name is none of the parameters.
        """
        for name in exponents:
            if name not in self.names:
                raise InvalidInput(f"parameter {name!r} does not exist: allowed are {', '.join(self.names)}")
        wanted = np.array([exponents.get(name, 0.0) for name in self.names])
        along = self.directions @ wanted
        if np.any(np.abs(along[self.rank :]) > _ALONG * np.linalg.norm(wanted)):
            return math.inf
        return float(np.linalg.norm(along[: self.rank] / self.strengths[: self.rank]))


def identifiability(names: Sequence[str], sensitivities: Array, nuisances: Array, noise: float) -> Identifiability:
    """From the derivatives of a measurement.

    Parameters
    ----------
    names : P of str
    sensitivities : (P, n) array
        Derivatives by the logarithms of the parameters.
    nuisances : (k, n) array
        Derivatives by whatever else is unknown, in any units.
    noise : float
        Standard deviation of white noise on the measurement, in its unit.
    """
    if not (math.isfinite(noise) and noise > 0.0):
        raise InvalidInput(f"noise = {noise!r}: must be finite and greater than 0")
    left = project_out(orthonormal(nuisances), sensitivities)
    longest = float(np.linalg.norm(sensitivities, axis=1).max(initial=0.0))
    directions, strengths, _ = np.linalg.svd(left, full_matrices=False)
    known = np.where(strengths > _SINGULAR * longest, strengths / noise, 0.0)
    return Identifiability(tuple(names), np.pad(known, (0, len(names) - known.size)), _complete(directions.T))


def _complete(rows: Array) -> Array:
    """Orthonormal rows (r, P) and as many more as make a basis."""
    if rows.shape[0] == rows.shape[1]:
        return rows
    return np.vstack([rows, np.linalg.svd(rows)[2][rows.shape[0] :]])
