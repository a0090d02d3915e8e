"""Wear over several recordings."""

import numpy as np
import pytest

from servotwin.estimation.kinematic.growth import YEAR, growth


def test_a_line_is_found_exactly_and_its_deviation_is_that_of_least_squares():
    dates = np.array([0.0, 0.5, 1.0, 2.0]) * YEAR + 1.7e9
    found = growth(dates, 3.0 + 0.25 * (dates - 1.7e9) / YEAR, [0.1] * 4)
    assert found.per_year == pytest.approx(0.25)
    assert found.std == pytest.approx(0.1 / np.sqrt(np.sum((dates / YEAR - np.mean(dates / YEAR)) ** 2)))
    low, high = found.interval
    assert low < 0.25 < high


def test_gaps_that_scatter_more_than_they_should_widen_the_interval():
    dates = np.arange(4) * YEAR
    assert growth(dates, [1.0, 2.0, 1.0, 2.0], [0.01] * 4).std > 10.0 * growth(dates, [1.0] * 4, [0.01] * 4).std


def test_a_scatter_that_three_gaps_show_is_known_poorly():
    # Student's t with one degree of freedom.
    found = growth(np.arange(3) * YEAR, [1.0, 2.0, 1.0], [0.01] * 3)
    assert found.interval[1] - found.per_year == pytest.approx(12.706 * found.std, rel=1e-3)


@pytest.mark.parametrize(
    ("dates", "gaps", "stds"),
    [([0, YEAR], [1, 2], [1, 1]), ([5, 5, 5], [1, 2, 3], [1, 1, 1]), ([0, 1, 2], [1, 2, np.nan], [1, 1, np.inf])],
    ids=["two", "one date", "one unknown"],
)
def test_no_line_without_three_gaps_on_different_dates(dates, gaps, stds):
    assert growth(dates, gaps, stds) is None
