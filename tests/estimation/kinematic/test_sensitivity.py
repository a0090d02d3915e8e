"""Sensitivity of the gap to what a model leaves."""

import numpy as np
import pytest

from servotwin.estimation.kinematic.sensitivity import sensitivity

PHASE = np.linspace(0.0, 20.0 * np.pi, 20_001)


def of(amplitude, gap=1.0, more=()):
    """Strokes of a play's output to +-amplitude, both flanks over the same way."""
    side = np.where(np.cos(PHASE) >= 0.0, 1, -1)
    output = amplitude * np.sin(PHASE)
    values = np.array([output, output, np.ones_like(output), *more])
    return sensitivity(values, range(1, len(values)), side, gap)


def test_long_strokes_have_the_least():
    assert of(50.0) == pytest.approx((1.0, 1.0), abs=1e-3)


def test_at_the_load_it_grows_where_the_load_hardly_moves():
    # The motor's way is then its gap and little more: corr^2 of the flank with it is g^2 / 4 / (g^2 / 4 + a^2 / 2).
    found = of(0.2)
    assert found.motor == pytest.approx(1.0, abs=1e-3)
    assert found.load == pytest.approx(np.sqrt(1.0 + 0.25 / 0.02), rel=1e-3)


def test_a_column_that_goes_with_the_flank_makes_it_large():
    assert of(50.0, more=[np.cos(PHASE)]).motor == pytest.approx(1.0 / np.sqrt(1.0 - 8.0 / np.pi**2), rel=1e-3)
