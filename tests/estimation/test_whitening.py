"""Noise put through its autoregression and back."""

import numpy as np
from scipy.signal import lfilter

from servotwin.estimation.core.whitening import Autoregression, burg


def noise_model() -> Autoregression:
    """Autoregression of a random walk in white noise."""
    rng = np.random.default_rng(3)
    return burg(0.1 * rng.normal(size=(1, 800)).cumsum(axis=1) + rng.normal(size=(1, 800)), 30)


def test_weights_of_the_innovations_are_filtered_backwards_in_time() -> None:
    """Beside scipy's filter, for weights of any layout."""
    model, weights = noise_model(), np.random.default_rng(4).normal(size=500)
    assert model.order > 5
    for each in (weights, weights[::-1], weights[:3]):
        expected = lfilter([model.spread[-1]], model.predictors[-1], each[::-1])[::-1]
        np.testing.assert_allclose(model.colour_back(each), expected, rtol=1e-12, atol=1e-14)


def test_white_noise_has_the_same_weights() -> None:
    weights = np.arange(4.0)
    np.testing.assert_array_equal(Autoregression.white(0.5).colour_back(weights), 0.5 * weights)
