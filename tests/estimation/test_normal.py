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


@pytest.mark.parametrize(("beside", "directions"), [(1.0, 5), (1e-3, 5), (1e-5, 5), (1e-7, 4), (0.0, 4)])
def test_least_squares_count_a_column_that_hardly_differs_from_others_or_are_the_shortest(
    beside: float, directions: int
) -> None:
    rng = np.random.default_rng(5)
    columns, target = rng.standard_normal((5, 80)), rng.standard_normal(80)
    columns[3] = columns[0] - columns[1] + beside * columns[3]
    found, size = least_squares(columns, target), np.linalg.norm(columns, axis=1)
    # The products' eigenvalues are squares of the singular values.
    shortest, *_ = np.linalg.lstsq((columns / size[:, None]).T, target, rcond=math.sqrt(1e-11))
    assert len(found.root) == directions
    assert found.coefficients * size == pytest.approx(shortest, rel=1e-4, abs=1e-4 * float(np.abs(shortest).max()))


def test_the_root_is_that_of_the_information_in_any_units() -> None:
    columns = np.random.default_rng(6).standard_normal((4, 50))
    units = np.array([1e-9, 1.0, 1e9, 1e3])
    root = least_squares(units[:, None] * columns, columns[0]).root * units
    assert root.T @ root == pytest.approx(np.linalg.inv(columns @ columns.T), rel=1e-9, abs=1e-15)
