"""The damped Gauss-Newton step within bounds, beside numpy's least squares."""

import numpy as np

from servotwin.estimation.core.bounded_step import bounded_step

RNG = np.random.default_rng(3)
ROWS = RNG.standard_normal((4, 60)) * np.array([[1.0], [1e3], [1e-4], [1.0]])
AT = np.array([1.0, 2e-3, 3e3, 1.0])
RESIDUAL = AT @ ROWS + 0.01 * RNG.standard_normal(60)
ANY, WIDE = np.ones(4, dtype=bool), np.full(4, np.inf)


def solved(rows):
    return np.linalg.lstsq(rows.T, RESIDUAL, rcond=None)[0]


def test_without_damping_the_step_is_that_of_least_squares_and_promises_what_it_takes_off():
    step, promised = bounded_step(RESIDUAL, ROWS, ANY, np.zeros(4), -WIDE, WIDE, 0.0)
    left = RESIDUAL - step @ ROWS
    np.testing.assert_allclose(step, solved(ROWS), rtol=1e-9)
    assert np.isclose(promised, RESIDUAL @ RESIDUAL - left @ left, rtol=1e-9)


def test_what_may_not_move_and_what_its_bound_holds_leave_the_others_their_own_minimum():
    q, high = np.array([0.0, 5.0, 0.0, 0.0]), np.array([np.inf, 5.0, np.inf, np.inf])
    step, _ = bounded_step(RESIDUAL, ROWS, np.array([True, True, True, False]), q, -WIDE, high, 0.0)
    np.testing.assert_allclose(step[[0, 2]], solved(ROWS[[0, 2]]), rtol=1e-9)
    assert step[1] == step[3] == 0.0


def test_a_step_ends_at_its_bound_and_a_row_of_zeros_does_not_move():
    rows = np.vstack([ROWS[:3], np.zeros(60)])
    step, _ = bounded_step(RESIDUAL, rows, ANY, np.zeros(4), -WIDE, np.array([0.5, 1.0, 1e9, 1.0]), 0.0)
    assert step[0] == 0.5
    assert step[3] == 0.0
