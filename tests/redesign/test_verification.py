"""Verification of the loop that runs: its own rate, fresh machines, the demands, what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.loop_set import PlantSet
from servotwin.plant.servo import PRESETS, Servo
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.redesign.certified.assess import assess, stillness
from servotwin.redesign.certified.attempt import Attempt, Question
from servotwin.redesign.certified.certificate import Certificate, NotVerified
from servotwin.redesign.certified.certify import certify, confirm
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.machines import draw, draw_independently
from servotwin.redesign.certified.margins import loop_margins, plant_set
from servotwin.redesign.certified.trial import Trial, trial_for
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design
from servotwin.simulation import simulate

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
    assert " deg at the motor, input bias of " in found.tried(SERVO)
    assert found.tried(SERVO).count("; not tried: measurement noise, a gap that grows while the loop moves, ") == 1
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


def test_a_certificate_says_that_its_moves_begin_with_the_weight_held() -> None:
    axis = Axis.preset("ball-screw")
    lift = axis.replace(load=replace(axis.load, force=-30.0))
    known, demands = Uncertainty(gap=(0.0063, 0.0063), step=(1e-4, 2e-4)), replace(SMALL, machines=4)
    for plant, share in ((lift, 1.0), (lift, 0.0), (axis, 1.0)):
        setting = Design(axis.pidf.replace(Ki=share * axis.pidf.Ki))
        tried = confirm(plant, known, setting, demands, trial_for(axis, known, demands))
        found = tried.best if isinstance(tried, NotVerified) else tried
        assert found is not None
        assert ("an integral that holds the load's constant force" in found.tried(plant)) == (
            plant is lift and share > 0.0
        )


def test_a_delay_between_the_shortest_and_the_longest_may_be_the_worst() -> None:
    """At 100 Hz two samples turn the joint's resonance against the loop, three less so: Ms was said to be 1.34."""
    axis = Axis.preset("robot-joint")
    law = axis.pidf.replace(sample_rate=100.0, Kp=0.3 * axis.pidf.Kp, Kd=0.3 * axis.pidf.Kd, Ki=0.0)
    known = Uncertainty(delay=3)
    plants = plant_set(axis, known, law.sample_rate)
    each = [plants.margins(law, delay) for delay in range(4)]
    assert each[2].Ms.max() > Demands().Ms_worst > max(each[0].Ms.max(), each[3].Ms.max())
    found = loop_margins(axis, known, law)
    assert found.Ms_worst == max(margins.Ms.max() for margins in each)
    assert found.gain_margin_worst == min(margins.gain_margin.min() for margins in each)
    assert loop_margins(axis, known, law, between=False).Ms_worst < found.Ms_worst


@pytest.mark.parametrize(
    ("plant", "law"),
    [
        (SERVO, OWN),
        (SERVO.replace(k_d=1e7), OWN.replace(Ki=0.0, Kp=0.6 * OWN.Kp, Kd=0.6 * OWN.Kd)),
        (Axis.preset("telescope"), Axis.preset("telescope").controller.replace(Ki=0.0)),
        (Axis.preset("two-mass-drive"), Axis.preset("two-mass-drive").controller),
    ],
    ids=["integral", "pushed back", "free in the gap", "cascade"],
)
def test_the_circle_criterion_says_nothing_of_a_gap_that_is_no_play_in_the_loop(plant, law) -> None:
    assert loop_margins(plant, NARROW, law).passivity == -math.inf


def test_a_shaft_without_any_gap_is_simulated_with_a_tiny_one() -> None:
    """Its flanks change without end wherever the torque changes sign: a verification ended in an error."""
    axis = Axis.preset("robot-joint")
    known = Uncertainty(gap=(0.0, 0.0), step=(0.02, 0.17))
    members = draw(axis, known, 2, 2)
    assert np.all(members.gap > 0.0)
    assert np.all(axis.p * members.gap < 1e-5 * 0.02)
    assert np.all(draw(SERVO, known.replace(step=(1e-4, 1e-3)), 2, 2).gap == 0.0)
