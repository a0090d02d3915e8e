"""Products of tables with states against numpy's."""

import numpy as np
import pytest

from servotwin.hybrid.flow import listed_product, tall_product


@pytest.mark.parametrize("columns", [0, 1, 3, 4, 7, 8, 12, 13, 16, 21])
def test_a_tall_product_is_the_matrix_times_the_state(columns: int) -> None:
    rng, rows, stride = np.random.default_rng(columns), 19, 23
    table, x, out = rng.normal(size=5 + 22 * stride), rng.normal(size=columns), np.full(rows, np.nan)
    tall_product(table, 5, stride, rows, x, out)
    assert np.allclose(out, x @ _columns(table, np.arange(columns), stride, rows), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("columns", [0, 1, 3, 4, 7, 8, 12, 13, 16, 21])
def test_a_listed_product_takes_the_columns_that_are_listed(columns: int) -> None:
    rng, rows, stride = np.random.default_rng(columns), 19, 23
    table, x, out = rng.normal(size=5 + 30 * stride), rng.normal(size=columns), np.full(rows, np.nan)
    which = np.sort(rng.permutation(29)[:columns])
    listed_product(table, 5, stride, rows, which, x, out)
    assert np.allclose(out, x @ _columns(table, which, stride, rows), rtol=0.0, atol=1e-14)


def _columns(table: np.ndarray, which: np.ndarray, stride: int, rows: int) -> np.ndarray:
    """(columns, rows) of a flat table that begins at 5."""
    return table[5 + stride * which[:, None] + np.arange(rows)]
