"""Filters with all poles at one place, against scipy on other realisations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial as poly
from scipy.signal import lsim, tf2ss

from servotwin.estimation.paper.observer import LagFilter, lag_polynomial
from servotwin.plant.backlash import play

numbers = st.floats(-3.0, 3.0)


def oracle(numerator, order, alpha, signal, interval):
    """scipy's first-order hold, the input rising from zero in the interval before the first sample."""
    in_units_of_alpha = np.asarray(numerator) * alpha ** (np.arange(len(numerator)) - float(order))
    system = tf2ss(in_units_of_alpha[::-1], np.poly(-np.ones(order)))
    times = alpha * interval * np.arange(signal.size + 1)
    return lsim(system, np.append(0.0, signal), times)[1][1:]


@given(st.integers(1, 9), st.floats(0.5, 200.0), st.data())
def test_lag_polynomial_is_the_same_function(order, alpha, data):
    numerator = np.array(data.draw(st.lists(numbers, min_size=1, max_size=order + 1)))
    s = alpha * (0.3 + 0.8j)
    lag = alpha / (s + alpha)
    exact = poly.polyval(s, numerator) / (s + alpha) ** order
    terms = np.abs(numerator) * np.abs(s) ** np.arange(numerator.size) / alpha**order
    assert poly.polyval(lag, lag_polynomial(numerator, order, alpha)) == pytest.approx(
        exact, abs=1e-12 * (1e-300 + terms.sum()) * 4**order
    )


@pytest.mark.parametrize("order", [1, 2, 4, 6, 8])
@pytest.mark.parametrize("alpha", [5.0, 40.0, 400.0])
def test_matches_scipy_for_inputs_linear_between_samples(order, alpha):
    interval = 2e-4
    rng = np.random.default_rng(order)
    numerator = rng.standard_normal(order + 1) * alpha ** np.arange(order, -1, -1.0)
    signal = np.cumsum(rng.standard_normal(300))
    ours = LagFilter.sampled(numerator, order, alpha, interval).respond(signal)
    theirs = oracle(numerator, order, alpha, signal, interval)
    assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


def test_a_step_settles_at_the_static_gain():
    lags = LagFilter.sampled(np.array([3.0 * 40.0**4, 7.0, 1.0]), 4, 40.0, 2e-4)
    assert lags.taps.sum() == pytest.approx(3.0, rel=1e-13)
    assert lags.respond(np.ones(5000))[-1] == pytest.approx(3.0, rel=1e-9)


@given(st.integers(1, 9), st.floats(0.0, 2.0), st.floats(-3.0, 3.0), st.integers(0, 2**31))
def test_the_fused_pass_is_the_play_operator_and_then_the_filter(order, gap, start, seed):
    rng = np.random.default_rng(seed)
    motor = np.cumsum(rng.standard_normal(200)) * 0.1
    lags = LagFilter.sampled(rng.standard_normal(order + 1), order, 1.0, 0.1)
    base = rng.standard_normal(200)
    residual = base.copy()
    lags.subtract_play(motor, 0.5 * gap, start, residual)
    expected = base - lags.respond(play(motor, gap, start))
    assert np.abs(residual - expected).max() <= 1e-12 * (1.0 + np.abs(expected).max())
