"""Scrambled Sobol points, the same as those of `scipy.stats.qmc.Sobol`, whose import takes half a second.

Direction numbers: Joe & Kuo, "Constructing Sobol sequences with better two-dimensional projections", SIAM J. Sci.
Comput. 30(5), 2008. Scrambling: Matousek, "On the L2-discrepancy for anchored boxes", J. Complexity 14(4), 1998.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.signals import Array

_BITS = 30
# Of the bits, the most significant one first.
_PLACES = np.arange(_BITS - 1, -1, -1)
# Of each dimension after the first: a primitive polynomial over {0, 1}, one bit for each coefficient, and the first
# direction numbers.
_DIRECTIONS = (
    (3, (1,)),
    (7, (1, 3)),
    (11, (1, 3, 1)),
    (13, (1, 1, 1)),
    (19, (1, 1, 3, 3)),
    (25, (1, 3, 5, 13)),
    (37, (1, 1, 5, 5, 17)),
)
DIMENSIONS = len(_DIRECTIONS) + 1


def sobol(dimensions: int, log2_count: int, seed: int) -> Array:
    """Scrambled Sobol points.

    Parameters
    ----------
    dimensions : int
        At most `DIMENSIONS`.
    log2_count : int
        Logarithm of the number of points to base 2.
    seed : int

    Returns
    -------
    (2**log2_count, dimensions) array
        In 0 .. 1, balanced.
    """
    shift, vectors = _scrambled(dimensions, seed)
    # In the order of the Gray code each point differs from the one before it by one vector.
    numbers = np.arange(1, 2**log2_count)
    changed = np.log2(numbers & -numbers).astype(np.int64)
    steps = np.concatenate([shift[None], vectors[:, changed].T])
    return np.asarray(np.bitwise_xor.accumulate(steps) * 0.5**_BITS)


def _scrambled(dimensions: int, seed: int) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """(dimensions,) first point and (dimensions, bits) vectors, each multiplied by a random triangular matrix."""
    rng, powers = np.random.default_rng(seed), 2 ** np.arange(_BITS, dtype=np.uint64)
    shift = rng.integers(2, size=(dimensions, _BITS), dtype=np.uint32) @ powers
    triangular = np.tril(rng.integers(2, size=(dimensions, _BITS, _BITS), dtype=np.uint32))
    triangular[:, np.arange(_BITS), np.arange(_BITS)] = 1
    bits = np.array([_vectors(k) for k in range(dimensions)])[..., None] >> _PLACES & 1
    mixed = np.einsum("dpk,djk->djp", triangular, bits) % 2
    return shift, mixed.astype(np.uint64) @ powers[::-1]


def _vectors(dimension: int) -> list[int]:
    """Direction vectors of a dimension, one for each bit."""
    if dimension == 0:
        return [1 << (_BITS - 1 - j) for j in range(_BITS)]
    polynomial, first = _DIRECTIONS[dimension - 1]
    degree, numbers = len(first), list(first)
    for j in range(degree, _BITS):
        number = numbers[j - degree]
        for k in range(1, degree + 1):
            if polynomial >> (degree - k) & 1:
                number ^= numbers[j - k] << k
        numbers.append(number)
    return [number << (_BITS - 1 - j) for j, number in enumerate(numbers)]
