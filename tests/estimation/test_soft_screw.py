"""A screw that is softer than the model's, and sensors that lag: bounds hold, intervals contain it, and it is said."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.corrupted import corrupted_windows
from benchmarks.estimator_windows import cut
from benchmarks.wrong_models import ModelError, step_windows, worn_run
from servotwin.estimation import whitened
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.learning.machine import LearningSettings, nameplate
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.whitened.free_model import COMPLIANCE, FactorPrior, FreeProblem
from servotwin.estimation.whitened.learning import WindowSoftness
from servotwin.estimation.whitened.sensor_errors import lag_motion
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate
from servotwin.twin.estimating import estimator_of
from servotwin.twin.settings import TwinSettings

MODEL = Servo.preset("paper")
NAMEPLATE = nameplate(LearningSettings(), 0.15, 0.5, 0.1)


def fitted(case, machine=NAMEPLATE):
    return whitened.fit(case.window, case.servo, None, whitened.WhitenedSettings(), machine)


@pytest.mark.slow
def test_a_lower_bound_lies_below_the_gap_of_a_machine_with_a_soft_screw():
    """It lay up to 0.5 deg above: the lead was that of a rigid screw, and of a fit that had stopped early."""
    bounds = []
    for case in corrupted_windows("soft screw", 48, 5001):
        if not case.two_contacts and case.words.startswith(("2 masses", "3 masses")) and "calm" in case.words:
            estimate = fitted(case).concluded()
            if estimate.status is GapStatus.LOWER_BOUND:
                bounds.append(estimate.gap - case.gap)
    assert len(bounds) >= 2
    assert max(bounds) <= 0.0


def paper_case(gap=10.0):
    run = simulate(
        MODEL,
        7.0,
        controller=MODEL.controller,
        reference=SquareWave(1e-3, 10.0),
        gap=math.radians(gap),
        tolerance=MODEL.tolerance_for(math.radians(gap)),
    )
    return cut(run, 5.0, 1.0)


@pytest.mark.parametrize("channel", ["position", "theta_m"])
def test_a_lag_differs_from_a_delay_by_the_motion_that_is_stated(channel):
    """Of the lag's difference from a delay, the motion leaves less than a quarter, nuisances aside."""
    case, lag = paper_case(), 2e-3
    decay = math.exp(-1.0 / (5000.0 * lag))
    reduction = fitted(case, None).aligned.whitened.reduction
    fit = fitted(case, None).aligned.whitened
    screw = reduction.traced(fit.point)
    delay = lag if channel == "position" else -lag
    motion = lag_motion(reduction, fit.point, screw, delay)
    samples = getattr(case.window, channel)
    lagging = samples[0] + lfilter(np.full(2, 0.5 - 0.5 * decay), [1.0, -decay], samples - samples[0])
    late = np.interp(np.arange(samples.size) - lag * 5000.0, np.arange(samples.size), samples)
    if channel == "position":
        truth = reduction.decimation.rows((lagging - late)[None])[0]
    else:
        # The true angle is as far from the delayed one as this from the lagging one.
        turned = replace(reduction, theta_m=late - late[0]).traced(fit.point)[:1]
        clipped = replace(reduction, theta_m=lagging - lagging[0]).traced(fit.point)[:1]
        truth = reduction.reduced.respond(turned - clipped)[0]
    begun = slice(30, None)
    left = truth[begun] - motion[begun]
    assert np.linalg.norm(left - left.mean()) < 0.25 * np.linalg.norm(truth[begun] - truth[begun].mean())


def test_a_lag_widens_the_interval_and_a_delay_that_cannot_be_one_hardly_does():
    """Both delay the channel by 3 ms; the lag rounds it off besides, which one micrometre of noise lets be seen."""
    case = paper_case()
    case = case.noisy(np.random.default_rng(1).normal(0.0, 1e-6, case.window.position.size))
    position = case.window.position
    held = np.concatenate([np.full(15, position[0]), position[:-15]])
    decay = math.exp(-1.0 / (5000.0 * 3e-3))
    lagging = position[0] + lfilter([1.0 - decay], [1.0, -decay], position - position[0])
    late, lags = (case.replaced(case.window.replace(position=one), case.servo) for one in (held, lagging))
    known = FactorPrior.of_spreads(2e-4, 1e-3, 1e-4, 1e-3)
    plain, delayed, lagged = (fitted(one, known).learnt.doubt(1e-6, 1.1) for one in (case, late, lags))
    assert plain < delayed < plain + math.radians(5e-4) < lagged


def test_the_softness_of_some_windows_is_their_weighted_mean_and_ends_at_a_floor():
    window = WindowSoftness(0.01, 4e6, 2.0)
    assert window.joined((0.0, 0.0), 1.0) == pytest.approx((0.01, 4e6))
    assert window.joined((0.02, 4e6), 1.0) == pytest.approx((0.015, 8e6))
    assert window.joined((0.02, 9e6), 1.0)[1] == 1e7
    assert WindowSoftness(0.0, 0.0, 2.0).joined((0.0, 0.0), 1.0) == (0.0, 0.0)
    assert window.moved((0.01, 1e7), 1.0) == pytest.approx(0.02, rel=1e-3)
    assert WindowSoftness(0.0, 0.0, 2.0).moved((0.0, 0.0), 1.0) == pytest.approx(2.0 * COMPLIANCE)


def test_the_compliance_is_the_last_derivative_where_it_is_kept():
    case = paper_case()
    whole = fitted(case).aligned.whitened
    problem = FreeProblem(whole.reduction, whole.noise, MODEL, NAMEPLATE, 1.0, COMPLIANCE)
    q = np.array([*whole.point, 0.0, 0.0, 0.0, 0.0])
    (_, rows), (_, kept) = problem.rows(q), problem.rows(q, keep=True)
    assert (len(rows), len(kept)) == (6, 7)
    off = kept[-1] / np.linalg.norm(kept[-1])
    assert kept[:-1] - np.outer(kept[:-1] @ off, off) == pytest.approx(rows, abs=1e-6 * np.linalg.norm(rows))


def test_a_window_that_shows_nothing_of_a_factor_leaves_what_is_known_of_it_as_it_was():
    """With two masses there is no mass ratio: its spread grew by a tenth with every window."""
    model = MODEL.replace(n=2)
    run = simulate(model, 7.0, controller=model.controller.replace(Kp=0.3 * model.controller.Kp, Ki=0.0,
                   Kd=0.3 * model.controller.Kd), reference=SquareWave(1e-3, 10.0), gap=math.radians(5.0))  # fmt: skip
    case = cut(run, 5.0, 1.0)
    learnt = fitted(case).learnt
    after = np.array(learnt.reading(1.1).covariance).reshape(4, 4)
    assert after[3, 3] == pytest.approx(NAMEPLATE.covariance[3, 3])
    assert np.all(np.diag(after) <= np.diag(NAMEPLATE.covariance) * (1.0 + 1e-9))


@pytest.mark.slow
def test_a_twin_of_a_machine_with_a_soft_screw_says_so_and_its_intervals_hold():
    """The structure's stiffness is a hundredth of the screw's: 32 of 45 estimates were off by 0.11 deg and outside."""
    rng, settings = np.random.default_rng(3), TwinSettings()
    machine = ModelError(0.05, 0.3, 0.005).machine(rng, MODEL)
    machine = machine.replace(k_d=100.0 * float(machine.stiffnesses.max()))
    run = worn_run(rng, MODEL, machine, "no dead zone", 8, math.radians(20.0))
    estimator, wear, said, accepted = estimator_of(MODEL, settings), Wear(0.0), "", 0
    for case in step_windows(run, "no dead zone", MODEL, 1e-6, rng):
        now = case.window.mid_time
        expected = wear.expect(settings.trend, "boot", now, now, settings.learning)
        estimate = estimator(case.window, expected)
        wear, _ = wear.update(settings.trend, "boot", estimate, now, settings.learning)
        said += wear.machine.alarm if wear.machine is not None else ""
        if estimate.ok:
            accepted += 1
            assert estimate.interval[0] <= case.gap <= estimate.interval[1]
    assert accepted >= 6
    assert "the screw is softer than the model says" in said


@pytest.mark.slow
@pytest.mark.parametrize(("loop", "least", "stiffness"), [("no dead zone", 7, 5e5), ("calm", 4, 2e5)])
def test_a_twin_learns_a_machine_whose_screw_is_elastic(loop: str, least: int, stiffness: float) -> None:
    """Model and screw are off; what the screw's stiffness does to the gap is in the interval."""
    rng, settings = np.random.default_rng(5), TwinSettings()
    model = MODEL.replace(k_d=stiffness)
    machine = ModelError(0.05, 0.3, 0.005).machine(rng, model).replace(k_d=1.18 * stiffness)
    run = worn_run(rng, model, machine, loop, 8, math.radians(20.0))
    estimator, wear, accepted = estimator_of(model, settings), Wear(0.0), 0
    for case in step_windows(run, loop, model, 1e-6, rng):
        now = case.window.mid_time
        expected = wear.expect(settings.trend, "boot", now, now, settings.learning)
        estimate = estimator(case.window, expected)
        wear, _ = wear.update(settings.trend, "boot", estimate, now, settings.learning)
        if estimate.ok:
            accepted += 1
            true = float(run.gap[round(estimate.time * run.sample_rate)])
            assert estimate.interval[0] <= true <= estimate.interval[1]
    assert accepted >= least
    assert wear.machine is not None
