"""Small least squares and their spreads."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st

from servotwin.estimation.core.least_squares import LeastSquares, independent_least_squares, least_squares

Fit = Callable[[np.ndarray, np.ndarray], LeastSquares]


@pytest.mark.parametrize("fit", [least_squares, independent_least_squares])
@examples(30, deadline=None)
@given(seed=st.integers(0, 1000), count=st.integers(1, 6))
def test_coefficients_and_deviations_are_those_of_the_covariance(fit: Fit, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    columns, target = rng.standard_normal((count, 40)), rng.standard_normal(40)
    found = fit(columns, target)
    exact, *_ = np.linalg.lstsq(columns.T, target, rcond=None)
    assert np.allclose(found.coefficients, exact)
    covariance = np.linalg.inv(columns @ columns.T)
    weights = rng.standard_normal(count)
    assert math.isclose(found.deviation(weights), math.sqrt(weights @ covariance @ weights), rel_tol=1e-9)


def test_a_column_that_depends_on_earlier_ones_is_undetermined() -> None:
    column, other = np.random.default_rng(0).standard_normal((2, 30))
    found = independent_least_squares(np.vstack([column, 2.0 * column, other]), column)
    assert found.coefficients == pytest.approx([1.0, 0.0, 0.0])
    assert math.isinf(found.deviation(np.array([0.0, 1.0, 0.0])))
    both = np.linalg.inv(np.array([[column @ column, column @ other], [other @ column, other @ other]]))
    assert found.deviation(np.array([1.0, 0.0, 0.0])) == pytest.approx(math.sqrt(both[0, 0]))


def test_a_column_of_zeros_is_undetermined() -> None:
    row = np.arange(1.0, 9.0)
    found = independent_least_squares(np.vstack([row, 0.0 * row]), row)
    assert math.isinf(found.deviation(np.array([0.0, 1.0])))
    assert found.deviation(np.array([1.0, 0.0])) == pytest.approx(1.0 / np.linalg.norm(row))
