"""Sobol points beside those of scipy."""

import numpy as np
import pytest
from scipy.stats import qmc

from servotwin.redesign.certified.sobol import DIMENSIONS, sobol


@pytest.mark.parametrize("dimensions", range(1, DIMENSIONS + 1))
def test_points_are_those_of_scipy_bit_for_bit(dimensions: int) -> None:
    for log2_count, seed in ((0, 1), (1, 2), (3, 0), (8, 2026)):
        points = sobol(dimensions, log2_count, seed)
        np.testing.assert_array_equal(points, qmc.Sobol(dimensions, seed=seed).random(2**log2_count))
