"""Angles between the counts of their encoder, and the errors that are left."""

import numpy as np
import pytest

from servotwin.estimation.core.counts import between_counts, errors_between, errors_of_counts

COUNT = 0.01


def motion(seed: int) -> np.ndarray:
    """A few hundred counts of smooth way with rests and turns."""
    random = np.random.default_rng(seed)
    speed = np.repeat(random.uniform(-0.5, 0.5, 12) * random.integers(0, 2, 12), 400)
    smooth = np.convolve(speed, np.hanning(201) / 100.0, "same")
    return COUNT * (random.uniform() + np.cumsum(smooth))


def rounded(angle: np.ndarray) -> np.ndarray:
    return COUNT * np.round(angle / COUNT)


def test_an_even_motion_is_found_again() -> None:
    angle = COUNT * (0.3 + 0.0137 * np.arange(9000))
    found = between_counts(rounded(angle), COUNT)
    assert np.abs(found - angle)[100:-100].max() < 0.03 * COUNT


@pytest.mark.parametrize("seed", range(8))
def test_no_angle_is_farther_from_its_count_than_before(seed: int) -> None:
    angle = motion(seed)
    found = between_counts(rounded(angle), COUNT)
    assert np.abs(found - rounded(angle)).max() <= 0.5 * COUNT * (1.0 + 1e-9)
    assert np.std(found - angle) < np.std(rounded(angle) - angle)


def test_an_angle_of_one_count_stays_as_it_is() -> None:
    still = np.full(50, 3.0 * COUNT)
    assert np.array_equal(between_counts(still, COUNT), still)
    assert np.unique(errors_between(still, COUNT, np.random.default_rng(0))).size == 1


def test_the_errors_that_are_drawn_are_as_large_as_those_that_are_made() -> None:
    random, made, drawn = np.random.default_rng(5), [], []
    for seed in range(60):
        angle = motion(seed)
        found = between_counts(rounded(angle), COUNT)
        made.append(np.mean((found - angle) ** 2))
        drawn.append(np.mean(errors_between(found, COUNT, random) ** 2))
    assert 0.7 < np.sqrt(np.mean(drawn) / np.mean(made)) < 1.5


def test_samples_that_show_one_count_have_one_error() -> None:
    channel = rounded(motion(3))
    errors = errors_of_counts(channel, COUNT, np.random.default_rng(1))
    same = np.diff(channel) == 0.0
    assert np.all(np.diff(errors)[same] == 0.0)
    assert np.abs(errors).max() <= 0.5 * COUNT
    assert np.std(errors) == pytest.approx(COUNT / np.sqrt(12.0), rel=0.3)
