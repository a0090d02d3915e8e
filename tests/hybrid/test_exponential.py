"""Matrix exponentials of the kernel: exact nilpotent chains, stiff and random matrices against scipy, powers."""

from decimal import Decimal, localcontext
from math import factorial

import numpy as np
import pytest
from scipy.linalg import expm

from servotwin.hybrid.exponential import expm1


def exact(flow: np.ndarray, time: float, terms: int = 40) -> np.ndarray:
    """exp(flow * time) - I in sixty digits, rounded once; no eigenvalue may turn by more than two radians or so."""
    with localcontext() as context:
        context.prec = 60
        digits = np.vectorize(Decimal, otypes=[object])
        term = total = step = digits(np.asarray(flow, dtype=float)) * Decimal(float(time))
        for order in range(2, terms):
            term = term @ step / Decimal(order)
            total = total + term
    return total.astype(float)


def off(result: np.ndarray, expected: np.ndarray) -> float:
    """Largest error of an entry relative to itself; zeros must be zeros."""
    some = expected != 0.0
    assert not result[~some].any()
    return float((np.abs(result - expected)[some] / np.abs(expected[some])).max())


def test_chain_of_integrators() -> None:
    flow, time = np.diag(np.ones(5), 1), 0.37
    expected = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1, 6):
            expected[i, j] = time ** (j - i) / factorial(j - i)
    assert off(expm1(flow, time), expected) < 1e-15


def test_zero_flow_and_zero_time() -> None:
    assert np.all(expm1(np.zeros((3, 3)), 0.1) == 0.0)
    assert np.all(expm1(np.ones((3, 3)), 0.0) == 0.0)


@pytest.mark.parametrize("seed", range(6))
def test_every_entry_has_its_own_digits(seed: int) -> None:
    """States of any units, steps of any size: what counts is an entry's own size, not the matrix's."""
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-6.0, 6.0, 4)
    flow = rng.standard_normal((4, 4)) * units[:, None] / units
    time = 10.0 ** rng.uniform(-9.0, -1.0)
    assert off(expm1(flow, time), exact(flow, time)) < 2e-15, seed


@pytest.mark.parametrize("size", [1, 2, 5, 9, 16])
@pytest.mark.parametrize("norm", [1e-9, 1e-2, 1.0, 30.0])
def test_against_scipy(size: int, norm: float) -> None:
    seed = 100 * size + int(norm)
    flow = np.random.default_rng(seed).standard_normal((size, size))
    flow *= norm / np.abs(np.linalg.eigvals(flow)).max()
    expected = expm(flow)
    result = expm1(flow, 1.0)
    scale = np.linalg.norm(expected, 2)
    assert np.abs(np.eye(size) + result - expected).max() < 1e-13 * scale * max(norm, 1.0), seed


def test_small_steps_keep_their_digits() -> None:
    """exp(A t) - I from exp(A t) would lose them: the deviation is as accurate as the step is small."""
    flow = np.array([[-3.0, 1.0], [0.5, -2.0]])
    time = 1e-9
    expected = flow * time + flow @ flow * (0.5 * time**2)
    assert np.abs(expm1(flow, time) / expected - 1.0).max() < 1e-15


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
    assert np.array_equal(scaled * scale / scale[:, None], plain)
