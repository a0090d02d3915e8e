"""Reported standard deviations against the scatter of repeated fits."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from servotwin.estimation.paper.residual import standard_deviation

N = 2000
T = np.linspace(0.0, 1.0, N)
WANTED, OTHER = np.sin(9.0 * T) + 0.5, np.exp(-3.0 * T)


def fitted(noise):
    """Linear fit of both columns to noise: (error of the first parameter, reported standard deviation)."""
    columns = np.column_stack([WANTED, OTHER])
    solution = np.linalg.lstsq(columns, noise, rcond=None)[0]
    return solution[0], standard_deviation(WANTED, OTHER, noise - columns @ solution)


def noises(colour, count=400):
    rng = np.random.default_rng(11)
    for _ in range(count):
        yield lfilter(*colour, rng.standard_normal(N + 500))[500:]


@pytest.mark.parametrize(
    "colour",
    [([1.0], [1.0]), ([1.0], [1.0, -0.9]), ([1.0, -0.95], [1.0]), ([1.0], [1.0, -1.9, 0.95])],
    ids=["white", "low", "high", "resonant"],
)
def test_reported_spread_is_the_scatter_whatever_the_colour(colour):
    errors, reported = np.transpose([fitted(noise) for noise in noises(colour)])
    assert 0.7 < math.sqrt(np.mean(reported**2)) / np.std(errors) < 1.4


def test_a_nuisance_takes_information_away():
    noise = np.random.default_rng(0).standard_normal(N)
    alone, beside = (standard_deviation(WANTED, other, noise) for other in (np.zeros(N), OTHER))
    assert beside > 1.05 * alone


@pytest.mark.parametrize("sensitivity", [np.zeros(N), OTHER, -3.0 * OTHER])
def test_nothing_known_is_infinite(sensitivity):
    assert standard_deviation(sensitivity, OTHER, np.random.default_rng(0).standard_normal(N)) == math.inf


def test_scales_like_the_residual_over_the_sensitivity():
    noise = np.random.default_rng(1).standard_normal(N)
    assert standard_deviation(4.0 * WANTED, OTHER, 8.0 * noise) == 2.0 * standard_deviation(WANTED, OTHER, noise)
