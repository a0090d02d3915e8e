"""First passage of an uncertain linear trend: closed forms, the bivariate normal by scipy, and simulated trends."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from servotwin.estimation.passage import both_below, passage


@pytest.mark.parametrize("correlation", [-0.95, -0.3, 0.0, 0.6, 0.99])
def test_two_normals_below_two_limits_as_scipy_integrates_them(correlation):
    points = np.array([(h, k) for h in (-2.0, -0.5, 0.0, 1.3) for k in (-1.7, 0.0, 0.4, 2.5)])
    expected = multivariate_normal.cdf(points, cov=[[1.0, correlation], [correlation, 1.0]], abseps=1e-9, releps=1e-9)
    found = both_below(points[:, 0], points[:, 1], np.full(len(points), correlation))
    np.testing.assert_allclose(found, expected, atol=2e-7)


def test_limits_of_correlation_and_of_the_limits():
    h, k = np.array([0.3, 0.3, math.inf, -math.inf]), np.array([-0.4, -0.4, 0.7, 0.7])
    found = both_below(h, k, np.array([1.0, -1.0, 0.2, 0.2]))
    expected = [norm.cdf(-0.4), max(0.0, norm.cdf(0.3) + norm.cdf(-0.4) - 1.0), norm.cdf(0.7), 0.0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_certain_trend_arrives_when_distance_over_rate_says():
    found = passage(np.array([0.1, 0.01]), np.zeros((2, 2)), 0.3)
    assert found.median == pytest.approx(20.0)
    assert found.interval == pytest.approx((20.0, 20.0))
    assert found.probability == 1.0
    never = passage(np.array([0.1, -0.01]), np.zeros((2, 2)), 0.3)
    assert never.interval == (math.inf, math.inf)
    assert never.probability == 0.0
    assert passage(np.array([0.3, -0.01]), np.zeros((2, 2)), 0.3).interval == (0.0, 0.0)


def test_a_known_gap_with_an_uncertain_rate_in_closed_form():
    """Passed by t if the rate exceeds distance / t: quantiles of a normal turned upside down."""
    rate, std, distance = 0.02, 0.004, 0.5
    found = passage(np.array([0.0, rate]), np.diag([0.0, std**2]), distance)
    assert found.interval[0] == pytest.approx(distance / (rate + 1.959963984540054 * std))
    assert found.interval[1] == pytest.approx(distance / (rate - 1.959963984540054 * std))
    assert found.median == pytest.approx(distance / rate)
    assert found.probability == pytest.approx(norm.cdf(rate / std), abs=1e-6)


def test_an_uncertain_sign_leaves_the_end_open():
    unsure = passage(np.array([0.0, 0.001]), np.diag([0.0, 0.001**2]), 0.5)
    assert unsure.interval[0] < unsure.median < math.inf
    assert unsure.interval[1] == math.inf
    assert unsure.probability == pytest.approx(norm.cdf(1.0), abs=1e-6)
    shrinking = passage(np.array([0.0, -0.001]), np.diag([0.0, 0.001**2]), 0.5)
    assert shrinking.median == math.inf
    assert shrinking.interval[0] < math.inf


def test_as_simulated_trends_pass():
    rng = np.random.default_rng(3)
    mean, covariance = np.array([0.1, 0.01]), np.array([[4e-4, -1e-5], [-1e-5, 4e-6]])
    gap, rate = rng.multivariate_normal(mean, covariance, 200_000).T
    with np.errstate(divide="ignore"):
        arrival = np.where(gap >= 0.3, 0.0, np.where(rate > 0.0, (0.3 - gap) / rate, math.inf))
    found = passage(mean, covariance, 0.3)
    for time, share in zip((found.interval[0], found.median, found.interval[1]), (0.025, 0.5, 0.975), strict=True):
        assert np.mean(arrival <= time) == pytest.approx(share, abs=0.004)


def test_walks_widen_the_interval():
    mean, covariance = np.array([0.1, 0.01]), np.diag([1e-6, 1e-8])
    plain = passage(mean, covariance, 0.3)
    for walks in ({"gap_walk": 0.01}, {"rate_walk": 5e-4}):
        wide = passage(mean, covariance, 0.3, **walks)
        assert wide.interval[0] < plain.interval[0] < plain.interval[1] < wide.interval[1]


tenths = st.integers(0, 1000).map(lambda n: n / 1000.0)


@given(tenths, st.floats(-0.1, 0.1), tenths, tenths, st.floats(-1.0, 1.0), tenths)
def test_quantiles_are_ordered(gap, rate, gap_std, rate_std, correlation, limit):
    cross = correlation * gap_std * rate_std
    found = passage(np.array([gap, rate]), np.array([[gap_std**2, cross], [cross, rate_std**2]]), limit)
    assert 0.0 <= found.interval[0] <= found.median <= found.interval[1]
    assert 0.0 <= found.probability <= 1.0
