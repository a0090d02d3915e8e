"""Machines that differ from their model: one contact is not taken for two, and the model is learnt from the windows."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from exploration import extent

from benchmarks.estimator_windows import cut
from benchmarks.wrong_models import ModelError, learning_twin
from servotwin.estimation import whitened
from servotwin.estimation.core.whitening import Autoregression
from servotwin.estimation.estimate import GapEstimate, GapStatus, MachineReading
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.learning.machine import LearningSettings, LearntMachine, nameplate, updated
from servotwin.estimation.whitened import estimate_carrying
from servotwin.estimation.whitened.free_model import FactorPrior, FreeProblem, adapted, contact_evidence
from servotwin.estimation.whitened.learning import coarse_search
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate

MODEL = Servo.preset("paper")
TRUTH = np.log([1.03, 0.75, 1.005, 1.02])
ROUGH = FactorPrior.of_spreads(0.1, 0.3, 0.01)


def machine_window(gap_deg=10.0, noise=1e-6, seed=1, factors=TRUTH, start=5.0):
    machine, gap = adapted(MODEL, factors), math.radians(gap_deg)
    run = simulate(
        machine,
        start + 2.0,
        controller=MODEL.controller,
        reference=SquareWave(1e-3, 10.0),
        gap=gap,
        tolerance=MODEL.tolerance_for(gap),
    )
    case = cut(run, start, 1.0)
    assert case.two_contacts
    size = case.window.position.size
    return case.noisy(np.random.default_rng(seed).normal(0.0, noise, size)) if noise else case


def problem_of(case, prior=ROUGH, noise=1e-6):
    settings = whitened.WhitenedSettings()
    window = case.window
    slow, points = coarse_search(window.theta_m, window.position, window.sample_rate, MODEL, 0.0, settings)
    return FreeProblem(slow, Autoregression.white(noise), MODEL, prior, 2.0 * float(np.ptp(slow.theta_m))), points


@pytest.mark.slow
def test_one_contact_with_a_model_a_little_off_is_not_taken_for_two():
    """It was: 37.81 deg, ok, 37.68 .. 37.94 deg, where the gap is 54.31 deg and the damping 5.7 % off."""
    machine = MODEL.replace(c=tuple(1.0568 * MODEL.dampings))
    run = simulate(
        machine,
        20.0,
        controller=MODEL.controller.replace(Ki=0.0),
        reference=SquareWave(1.4012e-3, 30.0),
        gap=math.radians(54.31),
        theta_d0=math.radians(22.563),
        tolerance=0.0,
    )
    window = Window.from_run(run, 14.7, 2.0)
    refused = estimate_gap(window, MODEL)
    assert refused.status is GapStatus.MODEL_MISMATCH
    assert "a damping off by +6" in refused.reasons[0]
    estimate = estimate_carrying(window, MODEL, None, whitened.WhitenedSettings(), None, ROUGH)
    assert estimate.status is GapStatus.LOWER_BOUND
    assert estimate.gap <= math.radians(54.31)


def test_a_screw_that_begins_in_contact_teaches_too():
    """Its place then has no derivative, which says nothing against the others."""
    case, gap = machine_window(), math.radians(10.0)
    settings = LearningSettings()
    new = nameplate(settings, 0.15, 0.5, 0.1)
    estimate = estimate_carrying(case.window, MODEL, None, whitened.WhitenedSettings(), None, new)
    assert estimate.ok
    assert abs(estimate.theta_d0 - float(case.window.theta_m[0])) == pytest.approx(0.5 * gap, rel=0.02)
    assert estimate.machine is not None
    assert np.abs(np.array(estimate.machine.factors[:3]) - TRUTH[:3]).max() < 0.02


def test_a_window_with_one_contact_teaches_the_machine_and_not_the_gap():
    """Whether the one contact or two explain it, stiffness and damping come out alike."""
    machine, prior = adapted(MODEL, TRUTH), nameplate(LearningSettings(), 0.05, 0.3, 0.02)
    law = MODEL.controller.replace(Ki=0.0, Kp=0.6 * MODEL.controller.Kp, Kd=0.6 * MODEL.controller.Kd)
    run = simulate(
        machine, 18.0, controller=law, reference=SquareWave(1e-3, 30.0), gap=math.radians(20.0), tolerance=0.0,
    )  # fmt: skip
    case = cut(run, 14.7, 2.0)
    assert not case.two_contacts
    noisy = case.noisy(np.random.default_rng(3).normal(0.0, 1e-6, case.window.position.size))
    estimate = estimate_carrying(noisy.window, MODEL, None, whitened.WhitenedSettings(), None, prior)
    assert estimate.status is GapStatus.LOWER_BOUND
    assert estimate.machine is not None
    spread = np.sqrt(np.diag(np.array(estimate.machine.covariance).reshape(4, 4)))
    assert np.all(np.abs(np.array(estimate.machine.factors) - TRUTH) <= 4.0 * spread)
    assert np.all(spread[:2] <= 0.2 * np.sqrt(np.diag(prior.covariance))[:2])
    known = updated(None, LearningSettings(), estimate, counts=False, now=0.0)
    assert known is not None
    again = estimate_carrying(
        noisy.window, MODEL, None, whitened.WhitenedSettings(), None, known.prior(LearningSettings(), 0.0)
    )
    assert not (again.status is GapStatus.LOWER_BOUND and again.machine is not None)


def test_two_contacts_are_believed_where_they_are():
    case = machine_window(factors=np.zeros(4))
    problem, points = problem_of(case, noise=1e-6)
    evidence = contact_evidence(problem, problem.reduction.misfit(problem.noise, points[0]), points[0])
    assert evidence.two
    assert evidence.rise > 1000.0


def test_derivatives_are_those_of_the_residual():
    """Where the residual vanishes, the derivatives of what is left off the nuisances are those of the motion."""
    case = machine_window(noise=0.0)
    problem, points = problem_of(case, FactorPrior.of_spreads(1e3, 1e3, 1e3, 1e3), noise=1e-9)
    fit = problem.descend(np.array([*points[0], 0.0, 0.0, 0.0, 0.0]), (True, True))
    q = np.array([*fit.point, *fit.factors])
    residual, rows = problem.rows(q)
    for index, step in enumerate((1e-6, None, 1e-5, 1e-5, 1e-5, 1e-5)):
        if step is None:  # the place has a kink in contact
            continue
        ahead, behind = (problem.rows(q + sign * step * np.eye(6)[index])[0] for sign in (1.0, -1.0))
        assert np.linalg.norm((behind - ahead) / (2.0 * step) - rows[index]) < 0.02 * np.linalg.norm(rows[index])
    assert residual.size > rows.shape[0]


def test_a_descent_ends_where_a_step_that_promises_little_leads_up(monkeypatch):
    problem, points = problem_of(machine_window(factors=np.zeros(4)), noise=1e-6)
    fit = problem.descend(np.array([*points[0], 0.0, 0.0, 0.0, 0.0]), (True, True))
    evaluated, smooth = [], FreeProblem.rows

    def ever_higher(self, q, keep=False):
        residual, rows = smooth(self, q, keep)
        evaluated.append(q)
        return residual * (1.0 + 1e-3 * len(evaluated)), rows

    monkeypatch.setattr(FreeProblem, "rows", ever_higher)
    near = np.array([*fit.point, *fit.factors])
    near[0] += 0.01 * np.sqrt(fit.covariance[0, 0] * fit.cost / fit.rows.shape[1])
    assert problem.descend(near, (True, True)).evaluations == 2


def test_without_noise_the_factors_come_out_exactly():
    fitted = whitened.fit(machine_window(noise=0.0).window, MODEL, None, None, ROUGH)
    assert fitted.learnt.free.factors == pytest.approx(TRUTH, abs=2e-5)
    assert fitted.concluded().gap == pytest.approx(math.radians(10.0), abs=math.radians(1e-3))


@pytest.mark.slow
def test_with_noise_the_spreads_hold_what_they_promise():
    """Squared distances of the factors, in standard deviations, are chi-squared with four degrees of freedom."""
    distances, errors = [], []
    for seed in range(8):
        fitted = whitened.fit(machine_window(seed=seed).window, MODEL, None, None, ROUGH)
        reading = fitted.learnt.reading(1.0)
        away = np.array(reading.factors) - TRUTH
        distances.append(away @ np.linalg.solve(np.array(reading.covariance).reshape(4, 4), away))
        gap_error = fitted.aligned.whitened.point.gap - math.radians(10.0)
        errors.append(gap_error / fitted.learnt.gap_std(1.0))
    assert 1.0 < np.mean(distances) < 8.0  # 4 for the right spreads; the sum has 32 degrees of freedom
    assert 0.3 < np.mean(np.square(errors)) < 2.7


def test_a_model_that_is_taken_as_exact_gives_no_estimate():
    assert not estimate_gap(machine_window().window, MODEL).ok
    estimate = estimate_carrying(machine_window().window, MODEL, None, whitened.WhitenedSettings(), None, ROUGH)
    assert estimate.ok
    assert estimate.interval[0] <= math.radians(10.0) <= estimate.interval[1]


def test_a_nameplate_wrong_by_a_factor_of_two_is_said_and_not_estimated():
    window = machine_window(factors=np.log([2.0, 2.0, 1.0, 1.0])).window
    estimate = estimate_carrying(
        window, MODEL, None, whitened.WhitenedSettings(), None, FactorPrior.of_spreads(0.03, 0.1, 0.01)
    )
    assert estimate.status is GapStatus.MODEL_MISMATCH


GIVEN = LearningSettings()


def reading_of(factors, std=1e-3, status=GapStatus.OK):
    reading = MachineReading(tuple(factors), tuple(np.diag([std**2] * 4).ravel().tolist()))
    return replace(GapEstimate(0.1, 1e-3, 1e-3, (0.09, 0.11), status, 0.0), machine=reading)


def test_time_widens_what_was_learnt_and_no_number_of_windows_goes_below_the_floor():
    machine = updated(None, GIVEN, reading_of((0.01, 0.1, 0.0, 0.0), 1e-9), True, 0.0)
    assert np.sqrt(np.diag(machine.prior(GIVEN, 0.0).covariance)) == pytest.approx(np.sqrt(GIVEN.floor))
    later = np.sqrt(np.diag(machine.prior(GIVEN, 4.0 * 86400.0).covariance))
    assert later[:2] == pytest.approx([2.0 * GIVEN.k_drift, 2.0 * GIVEN.c_drift], rel=1e-3)


def test_an_estimate_that_the_trend_refuses_teaches_nothing():
    machine = updated(None, GIVEN, reading_of((0.01, 0.1, 0.0, 0.0)), True, 0.0)
    assert updated(machine, GIVEN, reading_of((0.5, 0.1, 0.0, 0.0)), False, 1.0) == machine


def test_another_machine_is_learnt_only_when_windows_agree_on_it():
    machine = updated(None, GIVEN, reading_of((0.01, 0.1, 0.0, 0.0)), True, 0.0)
    other = reading_of((0.2, -0.3, 0.0, 0.0), status=GapStatus.MODEL_MISMATCH)
    once = updated(machine, GIVEN, other, False, 1.0)
    assert once.factors == machine.factors
    assert "not the one that was learnt" in once.alarm
    mixed = updated(updated(once, GIVEN, reading_of((0.01, 0.1, 0.0, 0.0)), True, 2.0), GIVEN, other, False, 3.0)
    assert mixed.rival.windows == 1  # two machines under one name never agree in a row
    thrice = updated(updated(once, GIVEN, other, False, 2.0), GIVEN, other, False, 3.0)
    assert thrice.factors == (0.2, -0.3, 0.0, 0.0)
    assert "learnt anew" in thrice.alarm


def test_a_model_that_moves_beyond_its_drift_raises_an_alarm():
    machine = updated(None, GIVEN, reading_of((0.0, 0.0, 0.0, 0.0), 1e-3), True, 0.0)
    still = updated(machine, GIVEN, reading_of((1e-4, 0.0, 0.0, 0.0), 5e-4), True, 1.0)
    moved = updated(machine, GIVEN, reading_of((8e-3, 0.0, 0.0, 0.0), 5e-4), True, 1.0)
    assert still.alarm == ""
    assert moved.alarm.startswith("the model drifts: k/m")


def test_a_drift_of_the_stiffness_shows_beside_a_damping_that_is_hardly_known():
    """The wide spread of one factor must not hide what happens to another."""
    wide, narrow = np.square([1e-3, 0.3, 1e-3, 0.1]), np.square([3e-4, 0.29, 1e-3, 0.1])
    before, after = (tuple(np.diag(each).ravel().tolist()) for each in (wide, narrow))
    machine = LearntMachine((0.0, 0.0, 0.0, 0.0), before, 0.0)
    for k, alarm in ((8e-3, True), (1e-3, False)):
        estimate = replace(reading_of((0.0, 0.0, 0.0, 0.0)), machine=MachineReading((k, 0.0, 0.0, 0.0), after))
        assert updated(machine, GIVEN, estimate, True, 1.0).alarm.startswith("the model drifts: k/m") is alarm


def test_the_nameplates_spread_is_that_of_the_stated_ranges():
    prior = nameplate(GIVEN, 0.15, 0.5, 0.1)
    spread = np.sqrt(np.diag(prior.covariance))
    assert spread == pytest.approx(
        np.array([math.hypot(0.15, 0.1), math.hypot(0.5, 0.1), 0.01 * math.sqrt(3.0), math.hypot(0.1, 0.1)])
        / math.sqrt(3.0)
    )


def test_a_machine_survives_its_encoding():
    machine = updated(None, GIVEN, reading_of((0.01, 0.1, 0.0, 0.0)), True, 5.0)
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(machine), type=LearntMachine) == machine


@pytest.mark.slow
@pytest.mark.random
@pytest.mark.parametrize(("loop", "few", "many"), [("calm", (2, 11), (20, 5)), ("dead zone", (2, 17), (10, 17))])
def test_a_twin_learns_its_machine(loop, few, many):
    """Stiffness within 5 %, damping 50 %, pitch 1 %, motor 10 % of the model, the gap growing: none wrong."""
    machines, seed = extent(few, many)
    tally = learning_twin(ModelError(0.05, 0.5, 0.01, 0.1), loop, machines, seed, steps=14)
    assert tally.false == 0, tally.examples
    assert tally.two_contacts_late >= machines
    assert tally.accepted_late >= 0.9 * tally.two_contacts_late
