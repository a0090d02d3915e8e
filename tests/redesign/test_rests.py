"""Friction and bias told apart by voltages at rest, on simulated motors with true Coulomb friction."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servotwin.control.gains import gains_of
from servotwin.estimation.disturbance import Disturbance, disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.window import Window
from servotwin.messages import Setting
from servotwin.plant.actuator import DcMotor
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.uncertainty import Range, Uncertainty
from servotwin.redesign.policy import Evidence
from servotwin.simulation import simulate

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
CALM = SERVO.controller.replace(Kp=0.7 * SERVO.controller.Kp, Kd=0.7 * SERVO.controller.Kd, Ki=0.0)
POLICY = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)))
ESTIMATE = GapEstimate(10.0 * DEG, 0.01 * DEG, 0.01 * DEG, (9.9 * DEG, 10.1 * DEG), GapStatus.OK, 1.0)
STALL = SERVO.k_T / SERVO.R
HALF = 20.0


def rests(friction: float, bias: float, feedforward: float = 0.0) -> list[Disturbance]:
    """Read four rests after moves to and fro; friction and bias in V."""
    run = simulate(
        SERVO,
        4.0 * HALF,
        controller=CALM.replace(feedforward=feedforward),
        reference=SquareWave(1e-3, 2.0 * HALF),
        gap=10.0 * DEG,
        sample_rate=500.0,
        friction=friction * STALL,
        input_bias=bias,
    )
    ends = [HALF * (move + 1) - 0.01 for move in range(4)]
    read = [disturbance(Window.from_run(run, start=end - 1.0, duration=1.0), SERVO) for end in ends]
    assert all(each.known for each in read)
    return read


def evidence(read: list[Disturbance], feedforward: float = 0.0, tuned_for: float | None = 10.0 * DEG) -> Evidence:
    setting = Setting(0.0, gains_of(CALM.replace(feedforward=feedforward)))
    before = tuple(each.bias for each in read[:-1])[-3:]
    return Evidence(ESTIMATE, read[-1], None, setting, tuned_for, rests=before)


def friction_of(seen: Evidence) -> Range:
    """Friction for which the policy verifies, V."""
    low, high = POLICY.ranges.friction(seen)
    return low / STALL, high / STALL


@pytest.mark.parametrize("bias", [0.0, 0.04, -0.07])
def test_rests_from_both_sides_differ_by_friction_and_those_from_one_side_do_not(bias: float) -> None:
    """None is further off the bias than the friction; a move that ends fast stops short of that."""
    friction = 0.03
    read = [each.bias for each in rests(friction, bias)]
    assert all(abs(each - bias) <= 1.001 * friction for each in read)
    forth, back, again, back_again = read
    assert 1.5 * friction < back - forth <= 2.002 * friction
    assert (again, back_again) == pytest.approx((forth, back), abs=0.1 * friction)


@pytest.mark.parametrize("friction", [0.02, 0.06])
@pytest.mark.parametrize("bias", [0.0, 0.05, -0.05])
def test_two_rests_from_both_sides_tell_friction_and_bias(friction: float, bias: float) -> None:
    seen = evidence(rests(friction, bias)[:2])
    low, high = friction_of(seen)
    assert low == 0.0
    assert friction <= high <= 1.5 * friction
    fed, (least, most) = POLICY.ranges.input_bias(seen)
    assert least < bias < most
    assert fed == pytest.approx(-bias, abs=0.1 * friction)


@pytest.mark.parametrize("bias", [0.05, -0.08])
@pytest.mark.parametrize("count", [2, 3, 4])
def test_rests_that_are_alike_speak_of_a_bias(bias: float, count: int) -> None:
    """Nothing is fed forward yet, so that nothing of it can be left."""
    seen = evidence(rests(0.0, bias)[:count])
    assert friction_of(seen) == (0.0, 0.0)
    fed, (least, most) = POLICY.ranges.input_bias(seen)
    assert fed == pytest.approx(-bias, abs=1e-3)
    assert least < bias < most


def test_rests_of_a_motor_at_which_an_elastic_screw_pulls_speak_of_no_friction() -> None:
    """They differ with the load's place: taken for friction, they would be fed forward, and few settings bear both."""
    policy = CertifiedPolicy(SERVO.replace(k_d=1e6), Uncertainty(input_bias=(-0.1, 0.1)))
    forth, back = (Disturbance(bias, 1e-5, 0.0, 0.3, 0.0) for bias in (-0.02, 0.03))
    seen = evidence([forth, back])
    assert policy.ranges.friction(seen) == (0.0, 0.0)
    fed, (least, most) = policy.ranges.input_bias(seen)
    assert fed == 0.0  # their middle is within what the range contains anyway
    assert least <= -0.02
    assert most >= 0.03


def test_a_first_rest_tells_neither() -> None:
    fed, (least, most) = POLICY.ranges.input_bias(evidence(rests(0.0, 0.05)[:1]))
    assert fed == 0.0
    assert least <= 0.0 < 0.05 <= most


def test_friction_after_moves_one_way_looks_like_a_bias_until_the_motor_comes_back() -> None:
    """Rests from one side are alike with friction as with a bias: the first one from the other side corrects it."""
    friction = 0.05
    forth, back, again, _ = rests(friction, 0.0)
    one_way = evidence([forth, again])
    assert friction_of(one_way) == (0.0, 0.0)
    assert POLICY.ranges.input_bias(one_way)[0] == pytest.approx(friction, rel=0.1)
    both = evidence([forth, again, back], feedforward=friction)
    assert friction <= friction_of(both)[1] <= 2.1 * friction
    assert POLICY.ranges.input_bias(both)[0] == pytest.approx(0.0, abs=0.1 * friction)


def test_a_feedforward_in_force_that_is_left_at_rest_shows_friction() -> None:
    """The bias that it stands for is not there any more, or was never one."""
    read = rests(0.0, 0.01, feedforward=-0.05)[:2]
    assert friction_of(evidence(read, feedforward=-0.05)) == pytest.approx((0.0, 0.04), rel=0.02)
    assert friction_of(evidence(read, feedforward=-0.05, tuned_for=None)) == (0.0, 0.0)
    assert friction_of(evidence(read, feedforward=-0.01)) == (0.0, 0.0)


def test_a_feedforward_that_its_limit_cut_shows_no_friction() -> None:
    limit = POLICY.feedforward_limit
    read = rests(0.0, 0.5, feedforward=-limit)[:2]
    assert friction_of(evidence(read, feedforward=-limit)) == (0.0, 0.0)


def test_a_motor_whose_friction_is_told_from_its_bias_counts_before_it_is_known_exactly() -> None:
    """Known to 4 mV, it explains a voltage at rest of 54 mV, and none of 10 mV."""
    std = 1.9e-3
    motor = LearntMotor((0.0, 0.0, 0.054, 0.0), (*[0.0] * 10, std**2, *[0.0] * 4, std**2), 0.0)
    held, small = Disturbance(-0.054, 1e-5, 0.0, 0.3, 0.0), Disturbance(-0.01, 1e-5, 0.0, 0.3, 0.0)
    first = replace(evidence([held]), motor=motor)
    fed, (least, most) = POLICY.ranges.input_bias(first)
    assert fed == 0.0
    assert (least, most) == pytest.approx((-1.96 * std, 1.96 * std), rel=0.01)
    assert friction_of(first) == pytest.approx((0.054 - 1.96 * std, 0.054 + 1.96 * std), rel=0.01)
    assert friction_of(replace(evidence([small]), motor=motor)) == (0.0, 0.0)


def test_friction_is_learnt_in_volts_and_is_a_torque_of_the_learnt_motor() -> None:
    """A gain of the motor that was learnt to be 10 % higher: the same voltage stalls 10 % more torque."""
    std, lag, known = 1.9e-3, 1.0 / 1.1 - 1.0, 1e-3
    covariance = np.diag(np.square([known, known, std, std]))
    motor = LearntMotor((0.0, lag, 0.054, 0.0), tuple(covariance.ravel().tolist()), 0.0)
    held = replace(evidence([Disturbance(-0.054, 1e-5, 0.0, 0.3, 0.0)]), motor=motor)
    assert friction_of(held) == pytest.approx((0.054 - 1.96 * std, 0.054 + 1.96 * std), rel=0.01)
    stated = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1), k_T=0.2))
    low, high = stated.ranges.friction(held)
    assert (low / STALL, high / STALL) == pytest.approx([1.1 * each for each in friction_of(held)], rel=0.01)


def test_a_rest_at_which_friction_and_bias_cancel_takes_nothing_back() -> None:
    """The rest before it was of both; a motor known to 2.9 mV told them apart there, and does so still."""
    std = 1.5e-3
    motor = LearntMotor((0.0, 0.0, 0.06, -0.06), (*[0.0] * 10, std**2, *[0.0] * 4, std**2), 0.0)
    both, cancelled = (Disturbance(bias, 1e-5, 0.0, 0.3, 0.0) for bias in (-0.12, 0.001))
    seen = replace(evidence([both, cancelled]), motor=motor)
    assert friction_of(seen) == pytest.approx((0.06 - 1.96 * std, 0.06 + 1.96 * std), rel=0.01)
    assert friction_of(replace(seen, rests=()))[0] == 0.0


def test_a_window_that_tells_friction_shows_more_than_integral_action_answers_to() -> None:
    """Where the gap's estimate is unusable too; a friction that is not known has integral action in force."""
    std, gains = 1e-4, gains_of(CALM.replace(Ki=0.02 * SERVO.controller.Ki))
    motor = LearntMotor((0.0, 0.0, 0.06, 0.0), (*[0.0] * 10, std**2, *[0.0] * 4, std**2), 0.0)
    rest = Disturbance(-0.06, 1e-5, 0.0, 0.3, 0.0)
    unusable = replace(ESTIMATE, status=GapStatus.UNIDENTIFIABLE)
    seen = replace(evidence([rest, rest]), estimate=unusable, motor=motor, setting=Setting(0.0, gains))
    assert POLICY.ranges.shows_more(seen)
    apart = [rest, replace(rest, bias=0.06)]
    assert not POLICY.ranges.shows_more(replace(seen, motor=None, disturbance=apart[1], rests=(apart[0].bias,)))


GANTRY = Axis.preset("gantry")
"""Its friction holds the motor at up to 1.25 N m of command: 0.5 of its own, and 0.0025 m/rad of the load's 300 N."""
OWN, HELD = 1.25, 1.25 * 1.25


def _axis_ranges(
    law: object, *found: float, stated: Range = (0.0, 0.0), motor: LearntMotor | None = None
) -> tuple[Range, Range]:
    """Bias and friction beyond the model's, from these rests of a gantry."""
    axis = GANTRY if law is None else GANTRY.replace(controller=law)
    policy = CertifiedPolicy(axis, Uncertainty(gap=(0.0, 0.3), step=(1.5e-3, 1e-2), input_bias=stated))
    last = Disturbance(found[-1], 1e-4, 0.0, 0.3, 0.0)
    setting = Setting(0.0, gains_of(axis.controller))
    seen = Evidence(ESTIMATE, last, None, setting, 0.01, motor=motor, rests=found[:-1])
    return policy.ranges.input_bias(seen)[1], policy.ranges.friction(seen)


def test_rests_that_the_models_friction_explains_show_neither_bias_nor_more_friction() -> None:
    assert GANTRY.command_of(GANTRY.own_friction) == pytest.approx(OWN)
    calm = GANTRY.controller.replace(Ki=0.0)
    for found in [(-1.2, -1.23, -1.21), (-1.2, 1.2), (1.5,), (0.0, 0.0)]:
        (low, high), friction = _axis_ranges(calm, *found)
        assert -0.01 < low <= 0.0 <= high < 0.01
        assert friction == (0.0, 0.0)


def test_rests_beyond_the_load_s_friction_behind_an_elastic_screw_speak_of_no_other_friction() -> None:
    """The motor's friction could not be simulated: the policy had no setting for such a machine."""
    load = Load((5.2, 5.2), (1e4, 1e4), (36.9, 36.9), friction=0.2)
    motor = DcMotor(SERVO.J, SERVO.R, SERVO.k_T, SERVO.k_B, SERVO.L)
    axis = Axis(motor, Transmission(SERVO.p, 1e5), load, SERVO.controller)
    policy = CertifiedPolicy(axis, Uncertainty(input_bias=(-0.1, 0.1)))
    apart = 4.0 * axis.command_of(axis.own_friction) + 0.02
    forth, back = (Disturbance(bias, 1e-5, 0.0, 0.3, 0.0) for bias in (-apart, apart))
    seen = evidence([forth, back])
    assert policy.ranges.friction(seen) == (0.0, 0.0)
    _, (least, most) = policy.ranges.input_bias(seen)
    assert least <= -apart
    assert most >= apart


def test_an_integral_may_hold_what_the_models_friction_does() -> None:
    """The next move begins with it, as if the bias changed by as much: that friction may be a quarter more."""
    known = LearntMotor((0.0, 0.0, OWN, 0.0), (*[0.0] * 10, 1e-6, *[0.0] * 4, 1e-6), 0.0)
    (low, high), friction = _axis_ranges(None, -0.4, 0.2, stated=(-3.0, 3.0), motor=known)
    assert (low, high) == pytest.approx((-0.5, 0.5))
    assert friction == (0.0, pytest.approx(0.0, abs=0.01))
    assert _axis_ranges(None, -1.2, 1.2, stated=(-3.0, 3.0), motor=known)[0] == pytest.approx((-1.5, 1.5))
    assert _axis_ranges(None, -1.3, 1.3, stated=(-3.0, 3.0), motor=known)[0] == pytest.approx((-1.25 * OWN, 1.25 * OWN))


@pytest.mark.parametrize("most", [0.0, 0.1, 0.3])
def test_rests_within_the_stated_ranges_make_no_question_harder(most: float) -> None:
    """The fallback set, too, is verified from an integral of zero."""
    for found in [(-0.4, 0.2), (-1.2, 1.2), (0.0, 0.0), (1.5,)]:
        low, high = _axis_ranges(None, *found, stated=(-most, most))[0]
        assert -most <= low <= high <= most


def test_rests_that_contradict_the_stated_bias_count_with_what_an_integral_may_hold() -> None:
    (low, high), _ = _axis_ranges(None, -3.0, -3.1, stated=(-0.1, 0.1))
    assert low < -3.1 < high < -0.1


def test_a_stated_bias_counts_as_far_as_the_rests_allow_it() -> None:
    calm = GANTRY.controller.replace(Ki=0.0)
    (low, high), _ = _axis_ranges(calm, 1.0, -1.0, stated=(-3.0, 0.2))
    assert (low, high) == pytest.approx((1.0 - HELD, 0.2))


def test_rests_that_no_bias_explains_show_friction_beyond_the_models() -> None:
    calm = GANTRY.controller.replace(Ki=0.0)
    (low, high), friction = _axis_ranges(calm, -2.0, 2.4, stated=(-3.0, 3.0))
    assert low < 0.2 < high
    assert friction == pytest.approx((0.0, (1.25 * 2.2 - OWN) * GANTRY.torque_of(1.0)))
    # One bias explains these.
    (low, high), friction = _axis_ranges(calm, -3.0, -4.0)
    assert (low, high) == pytest.approx((-3.0 - HELD, -4.0 + HELD))
    assert friction == (0.0, 0.0)
