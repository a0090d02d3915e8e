"""Verification of the loop that runs: its own rate, the worst plant, bounds of shares, what is refused."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from exploration import extent

from servotwin.commissioning.guarding import guarding
from servotwin.control.gains import gains_of
from servotwin.control.retuning import law_for_margins
from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.plant.axis import Axis
from servotwin.plant.loop_set import PlantSet
from servotwin.plant.servo import PRESETS, Servo
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.redesign.certified.assess import assess, stillness
from servotwin.redesign.certified.attempt import Attempt, Question
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.certify import certify, confirm
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.machines import draw, draw_independently, extreme_plants
from servotwin.redesign.certified.margins import loop_margins, widened
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.trial import Trial, trial_for
from servotwin.redesign.certified.uncertainty import PARAMETERS, LearntFactors, Uncertainty
from servotwin.redesign.design import Design
from servotwin.redesign.policy import Evidence
from servotwin.simulation import simulate
from servotwin.twin.settings import TwinSettings

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
OWN = SERVO.controller
SMALL = Demands(
    machines=16, conditions=4, screened=2, settled=0.8, scales=(0.5, 0.7), integral=(0.0,), beyond=Beyond(machines=4)
)
NARROW = Uncertainty(gap=(9.9 * DEG, 10.1 * DEG), input_bias=(-2e-4, 2e-4))


def inert_axis(rate: float) -> Servo:
    """A stiff axis whose motor alone makes the dynamics: it crosses over at 120 rad/s in continuous time."""
    axis = SERVO.replace(m=20.0, k=1e9, c=2e4, Ki=0.0, Kd=0.0, sample_rate=rate)
    return axis.replace(Kp=120.0 * axis.k_B / axis.p)


# --- equal questions


@pytest.mark.parametrize(
    ("known", "setting"),
    [
        (NARROW.replace(gap=tuple(map(np.float64, NARROW.gap))), Design(OWN)),
        (NARROW.replace(friction=(0, 0)), Design(OWN)),
        (NARROW.replace(friction=(-0.0, 0.0)), Design(OWN)),
        (NARROW, Design(OWN.replace(Kp=np.float64(OWN.Kp)))),
        (NARROW, Design(OWN.replace(feedforward=-0.0), -0.0)),
        (NARROW, Design(OWN, 0)),
    ],
)
def test_equal_questions_are_answered_on_the_same_machines(known: Uncertainty, setting: Design) -> None:
    """Caches of a process take them for one question: the answer must not depend on which was asked first."""
    trial = Trial()
    assert (known, setting) == (NARROW, Design(OWN))
    expected = Attempt(Question(SERVO, NARROW, SMALL, trial, 0.0), Design(OWN))._members
    found = Attempt(Question(SERVO, known, SMALL, trial, 0.0), setting)._members
    assert np.array_equal(found.gap, expected.gap)
    assert found.plants == expected.plants


# --- the loop that runs


@pytest.mark.slow
def test_a_loop_that_its_rate_makes_unstable_is_refused_in_a_sentence() -> None:
    """In continuous time the same gains are certified."""
    with pytest.raises(InvalidInput, match=r"at 50 Hz with up to 3 samples of delay; none is stable there") as caught:
        certify(inert_axis(50.0), NARROW, replace(SMALL, scales=(0.7, 1.0)))
    assert "\n" not in str(caught.value)
    calm = inert_axis(50.0).replace(sample_rate=None)
    assert isinstance(certify(calm, NARROW, SMALL), Certificate)
    found = confirm(inert_axis(50.0), NARROW, Design(inert_axis(50.0).controller), SMALL, Trial(8.0, 2.0, 50.0))
    assert isinstance(found, NotVerified)
    assert "is unstable at 50 Hz" in found.reason


@pytest.mark.slow
def test_a_slower_setting_is_verified_at_the_rate_of_the_axis() -> None:
    found = certify(inert_axis(50.0), NARROW, replace(SMALL, scales=(0.05, 0.1, 1.0), shapes=((1.0, 1.0),)))
    assert isinstance(found, Certificate)
    assert found.rate == 50.0
    assert found.setting.controller.Kp < 0.2 * inert_axis(50.0).controller.Kp
    assert found.loop is not None
    assert found.loop.Ms_worst <= 2.2
    assert "at 50 Hz" in found.tried(inert_axis(50.0))


def test_a_sampled_setting_is_simulated_with_its_ticks_counts_and_limits() -> None:
    """The oracle: one `simulate` per machine, whose loop is the edge's."""
    servo = SERVO.replace(sample_rate=500.0, voltage_limit=0.5, rate_limit=5.0, position_resolution=2e-6)
    setting = Design(servo.controller.replace(Ki=0.0, Kp=700.0, Kd=-70.0), 2e-5)
    known = NARROW.replace(input_bias=(-0.01, 0.01))
    members, trial = draw(servo, known, 2, 2, 3), Trial(10.0, 2.0, 50.0)
    (found,) = assess([setting], members, trial)
    assert found.saturated.any()
    for p, c in np.ndindex(2, 2):
        run = simulate(
            members.plants[p],
            10.0,
            controller=setting.controller,
            reference=members.step[p, c],
            gap=members.gap[p, c],
            tolerance=setting.tolerance,
            theta_d0=members.theta_d0[p, c],
            input_bias=members.input_bias[p, c],
            sample_rate=500.0,
        )
        last = (run.reference - run.position)[::10][-100:]
        assert found.tail[p, c] == pytest.approx(np.abs(last).max(), rel=1e-6)
        assert found.ripple[p, c] == pytest.approx(0.5 * np.ptp(last), rel=1e-6, abs=1e-12)


# --- the worst plant


@pytest.mark.slow
@pytest.mark.parametrize("rate", [None, 200.0])
def test_no_plant_of_the_stated_set_exceeds_the_worst_Ms(rate: float | None) -> None:
    servo = SERVO.replace(sample_rate=rate)
    demands = Demands(integral=(0.0,))
    laws = [setting.controller for setting in candidates_of(servo, Uncertainty(), demands, False, False)]
    fresh = draw_independently(servo, widened(Uncertainty(), demands), extent(128, 512), 11)
    plants = PlantSet.of([plant.plant() for plant in fresh.plants], rate)
    for law in laws:
        for delay in (0,) if rate is None else (0, 3):
            found = plants.margins(law, delay)
            assert found.stable.all()
            assert found.Ms.max() <= demands.Ms_worst * 1.01


def test_the_constant_with_hindsight_is_among_the_candidates_of_a_known_plant() -> None:
    exact = Uncertainty(k=0.01, c=0.02, k_B=0.01, m=0.01)
    found = {round(s.controller.Kp / OWN.Kp, 3) for s in candidates_of(SERVO, exact, Demands(), False, False)}
    assert {0.6, 1.0} <= found


@pytest.mark.parametrize("name", ["micro-positioner", "telescope", "gantry"])
def test_no_two_candidates_act_alike(name: str) -> None:
    # Each would be verified on machines of its own: a setting that hardly fails would be drawn until one sample passes.
    axis = Axis.preset(name)
    found = candidates_of(axis, Uncertainty(gap=(0.0, 1.0), step=(1e-5, 1e-4)), Demands(), True, False)
    acting = [
        replace(each, controller=law if law.Kd else law.replace(Tf=1.0)) for each in found for law in [each.controller]
    ]
    assert len(set(acting)) == len(found)


def test_learnt_factors_have_their_mean_and_covariance_and_narrow_the_set() -> None:
    covariance = ((4e-4, 1e-4), (1e-4, 9e-4))
    learnt = LearntFactors(("k", "c"), (0.02, -0.1), covariance)
    known = Uncertainty(learnt=learnt)
    plants = draw_independently(SERVO, known, 4000, 0).plants
    logs = np.log([[plant.k / SERVO.k, plant.c / SERVO.c] for plant in plants])
    assert logs.mean(axis=0) == pytest.approx([0.02, -0.1], abs=3e-3)
    assert np.cov(logs.T) == pytest.approx(np.array(covariance), rel=0.1, abs=2e-5)
    wide, narrow = (len(candidates_of(SERVO, each, Demands(), False, False)) for each in (Uncertainty(), known))
    assert narrow > wide
    assert extreme_plants(SERVO, known, 4, 0)[0] == SERVO
    with pytest.raises(InvalidInput, match="each must be one of k, c, k_B, m, k_T, p"):
        LearntFactors(("mass",), (0.0,), ((1.0,),))
    with pytest.raises(InvalidInput, match="symmetric and positive semidefinite"):
        LearntFactors(("k",), (0.0,), ((-1.0,),))
    assert set(learnt.names) < set(PARAMETERS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "count"),
    [("paper", 128), *(pytest.param(each, 1024, marks=pytest.mark.exploration) for each in PRESETS)],
)
def test_fresh_machines_settle_as_the_certificate_says(preset: str, count: int) -> None:
    servo, known = Servo.preset(preset), Uncertainty(input_bias=(-0.1, 0.1))
    found = certify(servo, known)
    assert isinstance(found, Certificate), found
    members = draw_independently(servo, known, count, 99)
    (measures,) = assess([found.setting], members, trial_for(servo, known, Demands()))
    assert measures.settled.mean() >= Demands().settled


def test_a_learnt_plant_gets_a_setting_that_the_stated_ranges_forbid() -> None:
    # A velocity feedforward makes calm gains as quick, so that livelier ones are not chosen.
    demands = replace(SMALL, scales=(0.5, 0.7, 1.0), velocity_feedforward=False)
    policy = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), demands)
    learnt = FactorPrior(np.zeros(4), np.diag(np.square([1e-3, 1e-2, 1e-3, 1e-3])))
    gap, spread = 10.0 * DEG, 0.02 * DEG
    estimate = GapEstimate(gap, spread, spread, (gap - spread, gap + spread), GapStatus.OK, 1.0)
    rest = Disturbance(0.0, 1e-5, 0.0, 0.3, 0.0)
    before, after = (policy.redesign(Evidence(estimate, rest, machine=each)) for each in (None, learnt))
    assert before.certificate is not None
    assert after.certificate is not None
    assert after.setting is not None
    stated = loop_margins(
        SERVO, widened(policy.uncertainty, policy.demands), law_for_margins(after.certificate.setting.controller)
    )
    assert stated.Ms_worst > 2.2
    assert after.certificate.cost < before.certificate.cost
    box = guarding(SERVO, TwinSettings(demands=policy.demands))
    assert box is not None
    assert after.setting.gains is not None
    assert box.limits.allows_gains(after.setting.gains, gains_of(SERVO.controller))


@pytest.mark.slow
def test_the_box_of_the_edge_admits_the_candidates_of_a_machine_learnt_more_or_less_well() -> None:
    """A motor's gain of which nothing is learnt rules the fastest laws out; slower ones with a notch come in."""
    servo, ranges = SERVO.replace(sample_rate=1000.0), Uncertainty(input_bias=(-0.1, 0.1))
    box = guarding(servo, TwinSettings(uncertainty=ranges))
    assert box is not None
    for width in (0.01, 0.04):
        covariance = np.diag(np.square([width, 3.0 * width, 0.1 * width])).tolist()
        learnt = LearntFactors(("k", "c", "p"), (0.0,) * 3, tuple(map(tuple, covariance)))
        laws = [each.controller for each in candidates_of(servo, ranges.replace(learnt=learnt), Demands(), True, False)]
        assert any(law.notch_hz and law.Kp < servo.controller.Kp for law in laws)
        assert all(box.limits.allows_gains(gains_of(law), gains_of(servo.controller)) for law in laws)


def motor(back_emf: float, friction: float, bias: float, std: float) -> LearntMotor:
    """Learnt motor; friction and bias in V."""
    spreads = np.square([1e-3, 0.08, std, std])
    return LearntMotor((back_emf, 0.0, friction, bias), tuple(np.diag(spreads).ravel().tolist()), 0.0)


@pytest.mark.slow
def test_a_learnt_motor_narrows_back_emf_and_friction_and_shows_the_bias_that_friction_hides() -> None:
    policy = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), replace(SMALL, scales=(0.5,)))
    gap, spread = 10.0 * DEG, 0.02 * DEG
    estimate = GapEstimate(gap, spread, spread, (gap - spread, gap + spread), GapStatus.OK, 1.0)
    # Friction of 45 mV holds the motor where 20 mV more than the bias push it.
    rest = Disturbance(0.05, 1e-5, 0.0, 0.3, 0.0)
    torque = SERVO.k_T / SERVO.R
    stated, sticky, smooth, unsure = (
        policy.redesign(Evidence(estimate, rest, motor=each, rests=(0.05, 0.05))).certificate
        for each in (
            None,
            motor(-0.07, 0.045, 0.03, 5e-4),
            motor(-0.07, 0.0, 0.05, 5e-4),
            motor(-0.07, 0.045, 0.03, 1.0),
        )
    )
    assert stated is not None
    assert sticky is not None
    assert smooth is not None
    assert unsure is not None
    assert stated.setting.controller.feedforward == smooth.setting.controller.feedforward == -0.05
    assert unsure.setting.controller.feedforward == -0.05
    assert sticky.setting.controller.feedforward == -0.03
    assert smooth.loop is not None
    assert stated.loop is not None
    # The margins are those of machines near the learnt one, not of all of the stated range.
    assert smooth.loop.Ms_worst < stated.loop.Ms_worst
    assert policy.ranges.friction(Evidence(estimate, rest, motor=motor(0.0, 0.045, 0.03, 5e-4))) == pytest.approx(
        ((0.045 - 9.8e-4) * torque, (0.045 + 9.8e-4) * torque), rel=1e-3
    )


@pytest.mark.parametrize(("share", "stays"), [(0.98, True), (0.5, False)])
def test_a_running_setting_that_is_hardly_dearer_stays(share: float, stays: bool) -> None:
    policy = CertifiedPolicy(SERVO, Uncertainty(), replace(SMALL, scales=(0.5, 0.7)))
    gap, spread = 10.0 * DEG, 0.02 * DEG
    estimate = GapEstimate(gap, spread, spread, (gap - spread, gap + spread), GapStatus.OK, 1.0)
    best = policy.redesign(Evidence(estimate)).certificate
    assert best is not None
    law = best.setting.controller
    running = replace(best.setting, controller=law.replace(Kp=share * law.Kp, Kd=share * law.Kd)).setting()
    again = policy.redesign(Evidence(estimate, setting=running))
    assert (again.setting is None) == stays
    assert ("in force already" in again.reason) == stays
    assert again.certificate is not None
    assert (again.certificate.setting.controller.Kp == running.gains.Kp) == stays
    assert again.certificate.cost <= 1.1 * best.cost


@pytest.mark.slow
def test_settings_are_compared_on_the_steps_that_the_machine_makes_and_verified_on_all() -> None:
    """A gentle loop is the cheaper one where the gap is a large part of the step."""
    one = replace(SMALL, shapes=((1.0, 1.0),), learnt_shapes=(), notch=False)
    policy = CertifiedPolicy(SERVO, Uncertainty(), replace(one, scales=(0.3, 0.5, 0.7, 1.0)))
    gap, spread = 25.0 * DEG, 0.02 * DEG
    estimate = GapEstimate(gap, spread, spread, (gap - spread, gap + spread), GapStatus.OK, 1.0)
    known = FactorPrior(np.zeros(4), np.diag(np.square([1e-3, 1e-2, 1e-3, 1e-3])))
    rest = Disturbance(0.0, 1e-5, 0.0, 0.3, 0.0)
    usual = (2e-3, 2.4e-3)
    large = policy.redesign(Evidence(estimate, rest, machine=known, steps=usual)).certificate
    assert large is not None
    assert large.step == policy.uncertainty.step
    costs = {}
    for scale, share in itertools.product(policy.demands.scales, (0.0, *policy.demands.velocity)):
        fed = share * SERVO.k_B / SERVO.p
        law = large.setting.controller.replace(Kp=scale * OWN.Kp, Kd=scale * OWN.Kd, velocity_feedforward=fed)
        run = simulate(SERVO, 60.0, controller=law, reference=SquareWave(1.1e-3, 20.0), gap=gap, tolerance=0.0)
        costs[law] = float(np.abs(run.reference - run.position)[run.time > 20.0].mean())
    assert large.setting.controller == min(costs, key=costs.__getitem__)


def test_a_velocity_feedforward_makes_moves_quicker_at_the_same_margins() -> None:
    known = NARROW.replace(usual_step=(1e-3, 1e-3))
    without, fed = (certify(SERVO, known, replace(SMALL, velocity_feedforward=velocity)) for velocity in (False, True))
    assert isinstance(without, Certificate)
    assert isinstance(fed, Certificate)
    assert without.setting.controller.velocity_feedforward == 0.0
    assert fed.setting.controller.velocity_feedforward > 0.0
    assert fed.loop is not None
    assert fed.loop.Ms_worst <= SMALL.Ms_worst
    gap, move = 10.0 * DEG, SquareWave(0.5e-3, 20.0)
    errors = [
        np.abs(run.reference - run.position)[run.time > 20.0].mean()
        for run in (
            simulate(SERVO, 60.0, controller=each.setting.controller, reference=move, gap=gap)
            for each in (without, fed)
        )
    ]
    assert errors[1] < 0.9 * errors[0]
    assert fed.overshoot < 0.25


@pytest.mark.slow
def test_a_first_voltage_at_rest_may_be_frictions_and_is_not_fed_forward() -> None:
    policy = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), replace(SMALL, scales=(0.5, 0.7)))
    gap, spread = 10.0 * DEG, 0.02 * DEG
    estimate = GapEstimate(gap, spread, spread, (gap - spread, gap + spread), GapStatus.OK, 1.0)
    rest = Disturbance(0.05, 1e-5, 0.0, 0.3, 0.0)
    made = [policy.redesign(Evidence(estimate, rest, rests=rests)) for rests in ((), (0.05,), (0.05, 0.05))]
    assert [each.setting.gains.feedforward for each in made] == [0.0, -0.05, -0.05]
    for each in made[:1]:
        low, high = each.certificate.input_bias
        assert low < 0.0
        assert high > 0.05
    smooth = policy.redesign(Evidence(estimate, rest, motor=motor(0.0, 0.0, 0.05, 5e-4)))
    assert smooth.setting.gains.feedforward == -0.05


# --- demands


def test_a_limit_cycle_of_a_tiny_step_is_not_settled() -> None:
    known = Uncertainty(gap=(0.2 * DEG, 0.3 * DEG), step=(2.5e-6, 2.5e-6))
    members = draw(SERVO, known, 2, 2)
    own, calm = assess([Design(OWN), Design(OWN.replace(Ki=0.0))], members, Trial())
    assert (own.ripple < 1e-5).all()
    assert not own.settled.any()
    assert calm.settled.all()
    assert (stillness(members) < 0.02 * 2.5e-6).all()


def test_a_bias_that_leaves_a_large_error_is_not_certified() -> None:
    found = certify(SERVO, NARROW.replace(input_bias=(-1.0, 1.0)), SMALL)
    assert isinstance(found, NotVerified)
    assert "mm in the end, and 0.25 mm are allowed" in found.reason


def test_the_certificate_says_what_was_tried_and_what_leaving_out_integral_action_costs() -> None:
    found = certify(SERVO, NARROW, SMALL)
    assert isinstance(found, Certificate)
    law = found.setting.controller
    assert found.beyond is not None
    assert (found.beyond.machines, found.beyond.settled) == (4, 1.0)
    assert found.error_per_volt == pytest.approx(1.0 / law.Kp)
    assert "verified on 16 simulated machines in continuous time: steps of" in found.tried(SERVO)
    assert " mm from rest" in found.tried(SERVO)
    turning = found.tried(Axis.preset("robot-joint"))
    assert " deg from rest" in turning
    assert " N m, friction" in turning
    assert found.ramp is not None
    assert found.ramp.settled == 1.0
    # A loop that lags by so much of a second is off by that on a ramp of twelve periods; the gap adds to it.
    lag = found.lag / (12.0 * trial_for(SERVO, NARROW, SMALL).unit)
    assert lag < found.ramp.error < 2.0 * lag
    speed = 1e-3
    ramp = PiecewiseCubic(np.array([0.0]), np.array([[0.0, speed, 0.0, 0.0]]))
    run = simulate(SERVO, 20.0, controller=law, reference=ramp, sample_rate=100.0)
    assert run.reference[-1] - run.position[-1] == pytest.approx(found.lag * speed, rel=1e-3)


def test_a_loop_that_meets_the_circle_criterion_has_no_limit_cycle_in_any_gap() -> None:
    """The analysis and the simulation agree; the servo's own integral action fails both."""
    plants = PlantSet.of([SERVO.plant()], None)
    calm = OWN.replace(Ki=0.0, Kp=0.6 * OWN.Kp, Kd=0.6 * OWN.Kd)
    assert plants.margins(calm).passivity[0] > 0.0 > plants.margins(OWN).passivity[0]
    for gap in (1.0, 30.0, 180.0):
        members = draw(SERVO, Uncertainty(k=0.0, c=0.0, k_B=0.0, m=0.0, gap=(gap * DEG, gap * DEG)), 1, 4)
        settled, hunting = assess([Design(calm), Design(OWN)], members, Trial(200.0, 20.0))
        assert settled.at_rest.all()
        assert not hunting.at_rest.any()


def test_a_shaft_without_any_gap_is_simulated_with_a_tiny_one() -> None:
    """Its flanks change without end wherever the torque changes sign: a verification ended in an error."""
    axis = Axis.preset("robot-joint")
    known = Uncertainty(gap=(0.0, 0.0), step=(0.02, 0.17))
    members = draw(axis, known, 2, 2)
    assert np.all(members.gap > 0.0)
    assert np.all(axis.p * members.gap < 1e-5 * 0.02)
    assert np.all(draw(SERVO, known.replace(step=(1e-4, 1e-3)), 2, 2).gap == 0.0)
