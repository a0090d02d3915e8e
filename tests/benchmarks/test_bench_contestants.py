"""The benchmark's contestants do the workload that they are timed on, and right."""

import math

import numpy as np
import pytest

from benchmarks import fits, hold, ours, solver, taylor
from benchmarks.workloads import UNIT, NoisyWorkload, SweepWorkload, WearWorkload
from servotwin.estimation.paper.observer import observer

WEAR = WearWorkload(duration=4.0, period=2.0)
SWEEP = SweepWorkload(side=3, duration=1.0)


def error(contestant, expected):
    return float(np.max(np.abs(contestant.prepare()() - expected))) / UNIT


def test_servotwin_does_not_hang_on_its_search_for_events():
    assert error(ours.wearing(WEAR), ours.refined_wear(WEAR)) < 1e-11
    assert error(ours.sweeping(SWEEP, 2), ours.refined_sweep(SWEEP)) < 1e-11
    noisy = NoisyWorkload(WEAR)
    assert error(ours.noisy(noisy), ours.refined_noisy(noisy)) < 1e-9


def test_hold_converges_at_first_order():
    errors = [error(hold.wearing(WEAR, rate), ours.refined_wear(WEAR)) for rate in (5e3, 20e3, 80e3)]
    orders = np.log(np.divide(errors[:-1], errors[1:])) / math.log(4.0)
    assert np.all((orders > 0.8) & (orders < 1.25)), (errors, orders)


def test_hold_converges_over_the_ensemble():
    coarse, fine = (error(hold.sweeping(SWEEP, rate, 2), ours.refined_sweep(SWEEP)) for rate in (5e3, 20e3))
    assert 2.5 < coarse / fine < 6.0


def test_hold_misses_only_the_contacts_of_a_sampled_run():
    noisy = NoisyWorkload(WEAR)
    assert 0.0 < error(hold.noisy(noisy), ours.refined_noisy(noisy)) < 1e-3


def test_threads_change_nothing():
    one, three = (hold.sweeping(SWEEP, 5e3, threads).prepare()() for threads in (1, 3))
    np.testing.assert_array_equal(one, three)


@pytest.mark.slow
def test_solver_agrees():
    wear = WearWorkload(duration=2.0, period=1.0)
    assert error(solver.wearing(wear), ours.refined_wear(wear)) < 1e-6


def test_heyoka_agrees():
    pytest.importorskip("heyoka")
    assert error(taylor.wearing(WEAR), ours.refined_wear(WEAR)) < 1e-9
    for lanes, threads in ((1, 1), (4, 2)):
        assert error(taylor.sweeping(SWEEP, lanes, threads), ours.refined_sweep(SWEEP)) < 1e-8


@pytest.mark.slow
def test_predictors_are_the_observer():
    case, model = fits.cases(WearWorkload(duration=8.0, period=4.0))[2], observer(WEAR.servo, fits.ALPHA)
    theta_m, position = case.window.theta_m, case.window.position
    expected = model.estimate(theta_m, position, case.window.sample_rate)
    # The package's observer starts one sample earlier.
    for predictor, tolerance in ((fits.with_loop, 1e-6), (fits.with_lfilter, 1e-2)):
        found = predictor(model, case)(theta_m)
        assert np.max(np.abs(found - expected)[1000:]) < tolerance * np.ptp(position)


def test_fits_find_the_gap():
    wear = WearWorkload(duration=8.0, period=4.0, final_gap=math.radians(20.0))
    contestants = fits.ours(wear), fits.scipy_fits(wear, "scipy", fits.with_loop), fits.ours(wear, "whitened")
    found = [contestant.prepare()() for contestant in contestants]
    paper, scipy, whitened = (fits.typical_error(wear, gaps) for gaps in found)
    assert max(paper, scipy) < 1.0
    assert whitened < 0.1


def test_wrong_answers_are_counted_and_refusals_are_not():
    truths = np.array([case.truth for case in fits.cases(WEAR)])
    gaps = truths + np.radians([0.25, -0.5, 3.0, np.nan])
    assert fits.wrong_answers(WEAR, gaps) == 1
    assert fits.typical_error(WEAR, gaps) == pytest.approx(0.375)
    assert math.isnan(fits.typical_error(WEAR, truths + 1.0))


def test_sensitive_members_are_left_out():
    assert ours.comparable(SWEEP).all()
    long = SweepWorkload(side=4, duration=20.0)
    assert 0.5 < np.mean(ours.comparable(long)) <= 1.0
