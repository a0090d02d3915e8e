"""Motion and reversals of a motor, from noisy counts too."""

import numpy as np
import pytest

from servotwin.estimation.paper.estimator import motion

RATE = 5000.0
T = np.arange(5000) / RATE


@pytest.mark.parametrize("turns", [0.4, 1.0, 3.0])
def test_counts_the_extremes_of_a_sine(turns):
    seen = motion(3.0 * np.cos(2.0 * np.pi * turns * T), RATE, rest_speed=0.1)
    inside = sum(1 for k in range(1, 100) if 0.02 < k / (2.0 * turns) < 0.98)
    assert seen.reversals == inside
    assert seen.moving > 0.9


def test_rest_is_neither_motion_nor_reversal():
    seen = motion(1e-4 * np.sin(2.0 * np.pi * 50.0 * T), RATE, rest_speed=0.1)
    assert (seen.moving, seen.reversals) == (0.0, 0)


def test_encoder_counts_are_no_reversals():
    count = 2.0 * np.pi / 4096
    assert motion(np.round(2.0 * T / count) * count, RATE, rest_speed=0.1).reversals == 0


def test_a_pause_between_two_moves_is_kept_out():
    angle = np.interp(T, [0.0, 0.3, 0.7, 1.0], [0.0, 1.0, 1.0, 0.0])
    seen = motion(angle, RATE, rest_speed=0.1)
    assert seen.reversals == 1
    assert seen.moving == pytest.approx(0.63, abs=0.04)
