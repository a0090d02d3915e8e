"""The polygon that stands for the screw between samples: its areas against a fine play operator, runs explained."""

import math

import numpy as np
import pytest
from exploration import examples
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.estimator_windows import random_cases
from servotwin.estimation.core.contacts import BY_GAP, BY_RATE, BY_START, SCREW, Gap, contacts, polygon, pushed
from servotwin.estimation.core.least_squares import orthonormal, project_out
from servotwin.estimation.core.response import response
from servotwin.plant.backlash import play

FINER, COUNT = 200, 120


def angle(sample: np.ndarray, seed: int) -> np.ndarray:
    """A motor (rad) that turns round a few times, bends little within a sample interval, and rests at both ends."""
    rng = np.random.default_rng(seed)
    waves = ((amplitude, rng.uniform(0.0, 2.0 * math.pi)) for amplitude in (1.0, 0.5, 0.2))
    swing = sum(a * np.sin(0.05 * k * sample + phase) for k, (a, phase) in enumerate(waves, start=1))
    return np.asarray(swing * np.sin(math.pi * sample / COUNT) ** 2)


def moments(values: np.ndarray, per_sample: int = 1) -> np.ndarray:
    """Area and first moment of a polygon, a sample interval being 1 long."""
    at = np.arange(values.size) / per_sample
    middle, product = 0.5 * (values[1:] + values[:-1]), at[1:] * values[1:] + at[:-1] * values[:-1]
    crossed = at[1:] * values[:-1] + at[:-1] * values[1:]
    return np.array([middle.sum(), (2.0 * product + crossed).sum() / 6.0]) / per_sample


@examples(60, deadline=None)
@given(st.floats(0.05, 1.5), st.floats(-1.0, 1.0), st.integers(0, 10**6))
def test_area_and_moment_are_those_of_the_fine_path(gap, place, seed):
    """To the cubic's error, not the line's.

    In the first interval it is a parabola; its error at a crest there may stay in the screw throughout.
    """
    coarse, fine = (angle(np.arange(COUNT * finer + 1) / finer, seed) for finer in (1, FINER))
    at, x = Gap(gap, 0.5 * gap * place), np.arange(FINER + 1) / FINER
    true = moments(play(fine, at.gap, at.theta_d0), FINER)
    exact, line = (np.abs(moments(path(coarse, at)[SCREW]) - true) for path in (polygon, contacts))
    parabola = coarse[0] + x * (coarse[1] - coarse[0]) + 0.5 * x * (x - 1.0) * np.diff(coarse[:3], 2)
    first = float(np.abs(fine[: FINER + 1] - parabola).max())
    assert np.all(exact <= (1e-4 + COUNT * first) * np.array([1.0, COUNT]) + 0.1 * line)


def test_a_contact_that_begins_between_two_samples():
    """A motor at constant speed meets the screw at 0.3 of an interval: a triangle, and steps of the derivatives."""
    theta_m = 0.1 * (np.arange(9.0) - 3.0)
    at = Gap(1.0, -0.27)
    screw, by_gap, by_start, _ = polygon(theta_m, at)
    true = np.maximum(np.linspace(theta_m[0], theta_m[-1], 8001) - 0.5, at.theta_d0)
    np.testing.assert_allclose(moments(screw), moments(true, 1000), rtol=1e-6)
    np.testing.assert_allclose(moments(by_gap), [-0.5 * 2.7, -0.25 * (64.0 - 5.3**2)], rtol=1e-12)
    np.testing.assert_allclose(moments(by_start), [5.3, 0.5 * 5.3**2], rtol=1e-12)
    np.testing.assert_array_equal(by_gap[[0, -1]], [0.0, -0.5])


def test_a_crest_between_two_samples_stays():
    """A parabola whose top lies midway: the screw keeps the top, which no sample shows."""
    theta_m = -0.01 * (np.arange(21.0) - 10.5) ** 2
    screw = polygon(theta_m, Gap(1.5, -5.0))[SCREW]
    assert screw[14] == pytest.approx(-0.75, abs=1e-15)
    assert play(theta_m, 1.5, -5.0)[14] == pytest.approx(-0.75 - 0.0025)


@examples(60, deadline=None)
@given(st.floats(0.05, 1.5), st.floats(-0.99, 0.99), st.integers(0, 10**6))
def test_derivatives_are_those_of_the_area(gap, place, seed):
    theta_m = angle(np.arange(COUNT + 1.0), seed)
    at, step = Gap(gap, float(theta_m[0]) + 0.5 * gap * place), 1e-6
    rows = polygon(theta_m, at)
    for row, up, down in (
        (BY_GAP, at._replace(gap=gap + step), at._replace(gap=gap - step)),
        (BY_START, at._replace(theta_d0=at.theta_d0 + step), at._replace(theta_d0=at.theta_d0 - step)),
    ):
        above, below = (moments((polygon(theta_m, side)[SCREW] - rows[SCREW]) / step) for side in (up, down))
        # A crest that only just touches the screw is a kink: there is no derivative.
        assume(np.allclose(above, -below, rtol=1e-2, atol=1e-2))
        difference = 0.5 * (above - below)
        assert difference == pytest.approx(moments(rows[row]), abs=2e-2, rel=1e-3)
    assert np.abs(rows[BY_RATE]).max() <= 0.5 * COUNT


def test_in_the_contact_that_it_begins_in_the_place_does_not_count():
    theta_m = np.linspace(0.0, -1.0, 50) ** 2 * -1.0
    rows = polygon(theta_m, Gap(0.2, 0.1))
    assert not np.any(rows[BY_START])
    assert np.all(rows[BY_GAP] == 0.5)


def test_runs_are_explained_to_less_than_a_hundredth_of_what_lines_leave():
    """Position of any run from its motor's angle, at the true gap: the evidence of a gap can be as small as 1e-12 m."""
    left = np.array([[share(case, f) for f in (polygon, contacts)] for case in some_cases()])
    assert np.median(left[:, 0]) < 3e-12
    assert np.median(left[:, 0] / left[:, 1]) < 0.01
    assert left[:, 0].max() < 2e-10


def some_cases():
    return random_cases(np.random.default_rng(8), 30, math.radians(60.0), True, constant=True)


def share(case, path) -> float:
    """rms (m) of what the true gap leaves of a window, encoder's offset and free motions aside."""
    angles, model = case.window.theta_m, response(case.servo, case.window.sample_rate)
    basis = orthonormal(np.vstack([np.ones(angles.size), model.free(angles.size)]))
    screw = path(angles - angles[0], Gap(case.gap, case.theta_d0 - float(angles[0])))[:1]
    left = project_out(basis, case.window.position[None] - case.window.position[0] - model.respond(screw))
    return float(np.sqrt(np.mean(left**2)))


def test_a_screw_that_rests_keeps_all_derivatives():
    """A growing gap never moves the screw: what the last push gave it stays, by the gap's rate too."""
    theta_m = np.sin(np.minimum(0.05 * np.arange(100.0), 0.5 * math.pi + 0.01))
    exact, samples = polygon(theta_m, Gap(0.5, 0.0)), contacts(theta_m, Gap(0.5, 0.0))
    np.testing.assert_array_equal(exact[1:, 40:], samples[1:, 40:])
    assert np.ptp(exact[BY_RATE, 40:]) == 0.0


@pytest.mark.parametrize(("before", "after"), [(0.0, 1e-3), (4e-4, -3e-4), (-2e-4, 5e-4)])
def test_in_contact_throughout_area_and_moment_are_those_of_the_cubic(before: float, after: float) -> None:
    """By Gauss's quadrature, which is exact for a quartic."""
    high, twist = 0.02, after - before
    slope = high - 0.5 * before - twist / 6.0
    nodes, weights = np.polynomial.legendre.leggauss(4)
    x, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    bow = x * (slope + x * (0.5 * before + x * twist / 6.0)) - high * x
    crest, begin, area, moment = pushed(0.0, high, before, after)
    assert (crest, begin) == (high, 0.0)
    assert area == pytest.approx(float(weights @ bow), rel=1e-9)
    assert moment == pytest.approx(float(weights @ (x * bow)), rel=1e-9)
