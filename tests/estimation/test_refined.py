"""Sampled motions between their samples: exact on cubics, also beside corners."""

from __future__ import annotations

import numpy as np
import pytest

from servotwin.estimation.output_error.between_samples import parts_needed
from servotwin.estimation.output_error.refined import PARABOLA, refined

PARTS = 5


def fine(count: int) -> np.ndarray:
    return np.arange((count - 1) * PARTS + 1) / PARTS


def test_a_cubic_is_exact_up_to_both_ends() -> None:
    time = np.arange(9.0)
    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.3, 0.1])
    assert refined(cubic(time), PARTS) == pytest.approx(cubic(fine(9)), abs=1e-12)
    assert refined(cubic(time[:4]), PARTS) == pytest.approx(cubic(fine(4)), abs=1e-13)
    parabola = np.polynomial.Polynomial([1.0, -2.0, 0.3])
    assert refined(parabola(time), PARTS, PARABOLA) == pytest.approx(parabola(fine(9)), abs=1e-13)


def test_it_goes_through_the_samples() -> None:
    values = np.random.default_rng(0).normal(size=40)
    assert np.array_equal(refined(values, PARTS)[::PARTS], values)


def test_a_corner_at_a_sample_stays_sharp() -> None:
    """Of a motor that starts with a jump of its speed, or of its acceleration."""
    time, start = np.arange(20.0), 8.0
    for power in (1, 2):

        def moved(at: np.ndarray, power: int = power) -> np.ndarray:
            return np.where(at < start, 0.0, (at - start) ** power)

        assert refined(moved(time), PARTS) == pytest.approx(moved(fine(20)), abs=1e-12)


def test_only_sharp_motions_need_parts() -> None:
    time = np.arange(400.0)
    smooth, load = np.sin(time / 40.0), 0.9 * np.sin(time / 40.0 - 0.1)
    sharp = np.where(time < 200.0, 0.0, 1.0 - np.exp(-(time - 200.0) / 2.0))
    assert parts_needed(smooth, load, 0.0, 1) == 1
    needed = [parts_needed(sharp, np.zeros(400), count, 1) for count in (1e-4, 1e-3, 1e-2, 1.0)]
    assert needed == sorted(needed, reverse=True)
    assert needed[0] == 8
    assert needed[-1] == 1
    # Without counts, noise, or a motor that is ever before its load nothing is small enough.
    assert parts_needed(sharp, sharp, 0.0, 1) == 8
    # Three lines in each part do as much as three parts.
    assert parts_needed(sharp, np.zeros(400), 1e-4, 3) == 3
