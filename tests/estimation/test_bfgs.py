"""The minimiser against closed forms and scipy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize, rosen, rosen_der

from servotwin.estimation.paper.bfgs import minimise


def quadratic(hessian, centre):
    def slope(x):
        gradient = hessian @ (x - centre)
        return 0.5 * float((x - centre) @ gradient), gradient

    return slope


@given(st.integers(1, 5), st.integers(0, 2**31))
def test_finds_the_centre_of_a_quadratic(size, seed):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((size, size))
    hessian, centre = root @ root.T + 0.1 * np.eye(size), rng.standard_normal(size)
    found = minimise(quadratic(hessian, centre), np.zeros(size), 1e-9, 1e-10)
    assert found.converged
    assert found.point == pytest.approx(centre, abs=1e-7)
    assert found.cost == pytest.approx(0.0, abs=1e-12)


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_goes_through_rosenbrocks_valley_like_scipy(x, y):
    start = np.array([x, y])
    found = minimise(lambda p: (float(rosen(p)), rosen_der(p)), start, 1e-8, 1e-12)
    theirs = minimize(rosen, start, jac=rosen_der, method="BFGS", options={"gtol": 1e-8})
    assert found.point == pytest.approx([1.0, 1.0], abs=1e-6)
    assert found.evaluations <= 3 * theirs.nfev + 20


def test_a_corner_counts_as_a_minimum():
    """Where the first parameter leaves its range the paper's cost has an edge: flat beyond, sloping before."""

    def slope(x):
        beyond = x[0] > 1.0
        cost = (0.0 if beyond else 1.0 - x[0]) + (x[1] - 2.0) ** 2
        return cost, np.array([0.0 if beyond else -1.0, 2.0 * (x[1] - 2.0)])

    found = minimise(slope, np.array([0.0, 0.0]), 1e-8, 1e-9)
    assert found.converged
    assert found.cost == pytest.approx(0.0, abs=1e-8)

    def ridge(x):
        return abs(x[0] - x[1]) + x[1] ** 2, np.array([np.sign(x[0] - x[1]), np.sign(x[1] - x[0]) + 2.0 * x[1]])

    assert minimise(ridge, np.array([1.0, 1.0]), 1e-8, 1e-9).converged


def test_the_minimiser_reports_that_it_did_not_converge():
    found = minimise(lambda p: (float(rosen(p)), rosen_der(p)), np.array([-1.2, 1.0]), 1e-8, 1e-12, iterations=3)
    assert not found.converged
    assert found.message == "no convergence in 3 iterations"


def test_starts_at_the_minimum():
    found = minimise(quadratic(np.eye(2), np.ones(2)), np.ones(2), 1e-8, 1e-9)
    assert (found.evaluations, found.message) == (1, "the gradient vanished")
