"""Other explanations of a window: what they do to the gap, weighted by how likely they are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from benchmarks.estimator_windows import cut
from servotwin.estimation import whitened
from servotwin.estimation.whitened.doubt import spread_over
from servotwin.estimation.whitened.fit import WhitenedFit
from servotwin.estimation.whitened.sensor_errors import cyclic_motions
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array, SquareWave
from servotwin.simulation import simulate

WIDE = 1e4  # prior standard deviation of what is free in any case


def with_sizes(rows: Array, known: int) -> Array:
    """Rows with one more sample for each size, which expects it to be 0 with a standard deviation of 1."""
    sizes = len(rows) - known
    return np.hstack([rows, np.vstack([np.zeros((known, sizes)), np.eye(sizes)])])


def likelihood(residual: Array, columns: Array, stds: Array) -> float:
    """Logarithm of the marginal likelihood of a residual in white noise."""
    covariance = np.eye(residual.size) + (columns.T * stds**2) @ columns
    return float(multivariate_normal.logpdf(residual, cov=covariance))


@pytest.mark.parametrize("seed", range(4))
def test_the_spread_is_that_of_bayes_theorem(seed: int):
    rng, known, groups = np.random.default_rng(seed), 2, [[2], [3, 4]]
    rows = rng.normal(0.0, 1.0, (5, 12))
    residual = rng.normal(0.0, 1.0, 12) + 2.0 * (seed % 2) * rows[2]
    total, free = 0.0, rows[:known]
    alone = np.linalg.lstsq(free.T, residual, rcond=None)[0][0]
    plain = likelihood(residual, free, np.full(known, WIDE))
    for group in groups:
        columns, stds = np.vstack([free, rows[group]]), np.array([*known * [WIDE], *len(group) * [1.0]])
        covariance = np.linalg.inv(columns @ columns.T + np.diag(stds**-2.0))
        moved = float((covariance @ columns @ residual)[0]) - alone
        wider = covariance[0, 0] - np.linalg.inv(free @ free.T)[0, 0]
        odds = math.exp(2.0 + likelihood(residual, columns, stds) - plain)
        total += odds / (1.0 + odds) * (moved**2 + wider)
    padded = np.concatenate([residual, np.zeros(3)])
    assert spread_over(padded, with_sizes(rows, known), known, groups, 1.0) == pytest.approx(math.sqrt(total), rel=1e-4)


def test_what_the_window_contradicts_costs_nothing_and_what_it_does_not_tell_costs_all():
    samples = np.arange(1.0, 401.0)
    gap, other = np.sin(0.1 * samples), np.cos(0.1 * samples)
    told = np.vstack([gap, 100.0 * (other + 0.1 * gap)])
    untold = np.vstack([gap, 0.1 * gap])
    nothing = np.zeros(samples.size + 1)
    assert spread_over(nothing, with_sizes(told, 1), 1, [[1]], 1.0) < 0.05 * math.sqrt(1.0 / float(gap @ gap))
    # Odds of e^2 beforehand; the window says nothing.
    expected = 0.1 * math.sqrt(1.0 / (1.0 + math.exp(-2.0)))
    assert spread_over(nothing, with_sizes(untold, 1), 1, [[1]], 1.0) == pytest.approx(expected)


def clean_fit() -> WhitenedFit:
    model = Servo.preset("paper")
    run = simulate(
        model,
        7.0,
        controller=model.controller,
        reference=SquareWave(1e-3, 10.0),
        gap=math.radians(10.0),
        tolerance=None,
    )
    aligned = whitened.fit(cut(run, 5.0, 1.0).window, model, None, None).aligned
    assert aligned is not None
    return aligned.whitened


def test_a_position_that_errs_once_per_turn_shows_its_motion():
    fit = clean_fit()
    reduction, size = fit.reduction, 1e-3
    error = reduction.response.static_gain * size * np.sin(reduction.theta_m)
    expected = reduction.decimation.rows(error[None])[0]
    assert size * cyclic_motions(reduction, fit.point)[0] == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(("row", "wave"), [(2, np.sin), (3, np.cos)])
def test_an_angle_that_errs_once_per_turn_moves_the_screw_at_its_contacts(row: int, wave: np.ufunc):
    fit = clean_fit()
    reduction, size = fit.reduction, 1e-5
    moved = reduction.theta_m + size * wave(reduction.theta_m)
    start = moved[0] - reduction.theta_m[0]
    there = replace(reduction, theta_m=moved).traced(fit.point)[:1]
    change = reduction.reduced.respond(there - reduction.traced(fit.point)[:1])[0]
    expected = size * cyclic_motions(reduction, fit.point)[row]
    # Until the first contact the screw rests where it began, relative to the motor's first angle.
    begun = slice(change.size // 2, None)
    left = (change - expected)[begun]
    assert np.linalg.norm(left - left.mean()) < 0.02 * np.linalg.norm(expected[begun] - expected[begun].mean())
    assert abs(start) <= size
