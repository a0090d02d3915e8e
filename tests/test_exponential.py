"""Matrix exponentials of the kernel: exact nilpotent chains, stiff and random matrices against scipy, powers."""

from math import factorial

import numpy as np
import pytest
from scipy.linalg import expm

from servotwin.hybrid.exponential import expm1, powers, taylor_rows


def test_chain_of_integrators_is_exact() -> None:
    flow, time = np.diag(np.ones(5), 1), 0.37
    result = expm1(flow, time)
    expected = np.zeros((6, 6), dtype=np.longdouble)
    for i in range(6):
        for j in range(i + 1, 6):
            expected[i, j] = np.longdouble(time) ** (j - i) / factorial(j - i)
    assert result.dtype == np.longdouble
    assert np.abs(result - expected).max() < 1e-18


def test_zero_flow_and_zero_time() -> None:
    assert np.all(expm1(np.zeros((3, 3)), 0.1) == 0.0)
    assert np.all(expm1(np.ones((3, 3)), 0.0) == 0.0)


@pytest.mark.parametrize("size", [1, 2, 5, 9, 16])
@pytest.mark.parametrize("norm", [1e-9, 1e-2, 1.0, 30.0])
def test_against_scipy(size: int, norm: float) -> None:
    seed = 100 * size + int(norm)
    flow = np.random.default_rng(seed).standard_normal((size, size))
    flow *= norm / np.abs(np.linalg.eigvals(flow)).max()
    expected = expm(flow)
    result = expm1(flow, 1.0)
    scale = np.linalg.norm(expected, 2)
    assert np.abs(np.eye(size) + result.astype(float) - expected).max() < 1e-13 * scale * max(norm, 1.0), seed


def test_small_steps_keep_their_digits() -> None:
    """exp(A t) - I from exp(A t) would lose them: the deviation is as accurate as the step is small."""
    flow = np.array([[-3.0, 1.0], [0.5, -2.0]])
    time = 1e-9
    expected = flow * time + flow @ flow * (0.5 * time**2)
    assert np.abs(expm1(flow, time).astype(float) / expected - 1.0).max() < 1e-15


def test_rotation_and_stiff_decay() -> None:
    w, fast = 7.0, 1e4
    flow = np.zeros((3, 3))
    flow[0, 1], flow[1, 0], flow[2, 2] = w, -w, -fast
    t = 0.013
    expected = np.array(
        [[np.cos(w * t), np.sin(w * t), 0.0], [-np.sin(w * t), np.cos(w * t), 0.0], [0, 0, np.exp(-fast * t)]]
    )
    assert np.abs(np.eye(3) + expm1(flow, t) - expected).max() < 1e-15


def test_states_of_very_different_size() -> None:
    """Balancing: a similarity by 2**40 changes nothing but the scale."""
    flow = np.array([[-1.0, 2.0], [-3.0, -0.5]])
    scale = np.array([1.0, 2.0**40])
    plain = expm1(flow, 0.8)
    scaled = expm1(flow * scale[:, None] / scale, 0.8)
    assert np.abs(scaled * scale / scale[:, None] / plain - 1.0).max() < 1e-17


def test_powers() -> None:
    flow = np.array([[0.0, 1.0, 0.0], [-90.0, -0.3, 1.0], [0.0, 0.0, -20.0]])
    stack = powers(expm1(flow, 1e-3), 16)
    assert stack.shape == (16, 3, 3)
    for j in (1, 2, 7, 16):
        direct = expm1(flow, j * 1e-3)
        assert np.abs(stack[j - 1] - direct).max() < 1e-18 * j * np.abs(direct).max() * 16, j


def test_taylor_rows_sum_to_the_flow() -> None:
    rng = np.random.default_rng(5)
    flow, row = rng.standard_normal((4, 4)), rng.standard_normal(4)
    rows = taylor_rows(row, flow, 0.5, 24)
    s = 0.7
    total = np.sum([rows[k] * np.longdouble(s) ** k for k in range(24)], axis=0)
    assert np.abs(total.astype(float) - row @ expm(flow * 0.5 * s)).max() < 1e-14
    assert np.array_equal(taylor_rows(np.eye(4), flow, 0.5, 3).shape, (3, 4, 4))
