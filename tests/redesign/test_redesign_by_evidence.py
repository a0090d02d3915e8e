"""Settings for a machine of which something is learnt: plant, motor, bias, steps, the setting in force."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from servotwin.commissioning.guarding import guarding
from servotwin.control.gains import gains_of
from servotwin.control.retuning import law_for_margins
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.motor import LearntMotor
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.margins import loop_margins, widened
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.policy import Evidence
from servotwin.simulation import simulate
from servotwin.twin.settings import TwinSettings

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
OWN = SERVO.controller
SMALL = Demands(
    machines=16, conditions=4, screened=2, settled=0.8, scales=(0.5, 0.7), integral=(0.0,), beyond=Beyond(machines=4)
)


def known_gap(gap: float) -> GapEstimate:
    """Gap (rad) that is known to a fiftieth of a degree."""
    spread = 0.02 * DEG
    return GapEstimate(gap, spread, spread, (gap - spread, gap + spread), GapStatus.OK, 1.0)


@pytest.mark.slow
def test_a_learnt_plant_gets_a_setting_that_the_stated_ranges_forbid() -> None:
    # A velocity feedforward makes calm gains as quick, so that livelier ones are not chosen.
    demands = replace(SMALL, scales=(0.5, 0.7, 1.0), velocity_feedforward=False)
    policy = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), demands)
    learnt = FactorPrior(np.zeros(4), np.diag(np.square([1e-3, 1e-2, 1e-3, 1e-3])))
    estimate = known_gap(10.0 * DEG)
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


def motor(back_emf: float, friction: float, bias: float, std: float) -> LearntMotor:
    """Learnt motor; friction and bias in V."""
    spreads = np.square([1e-3, 0.08, std, std])
    return LearntMotor((back_emf, 0.0, friction, bias), tuple(np.diag(spreads).ravel().tolist()), 0.0)


@pytest.mark.slow
def test_a_learnt_motor_narrows_back_emf_and_friction_and_shows_the_bias_that_friction_hides() -> None:
    policy = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), replace(SMALL, scales=(0.5,)))
    estimate = known_gap(10.0 * DEG)
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


@pytest.mark.slow
def test_a_first_voltage_at_rest_may_be_frictions_and_is_not_fed_forward() -> None:
    policy = CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), replace(SMALL, scales=(0.5, 0.7)))
    estimate = known_gap(10.0 * DEG)
    rest = Disturbance(0.05, 1e-5, 0.0, 0.3, 0.0)
    made = [policy.redesign(Evidence(estimate, rest, rests=rests)) for rests in ((), (0.05,), (0.05, 0.05))]
    assert [each.setting.gains.feedforward for each in made] == [0.0, -0.05, -0.05]
    for each in made[:1]:
        low, high = each.certificate.input_bias
        assert low < 0.0
        assert high > 0.05
    smooth = policy.redesign(Evidence(estimate, rest, motor=motor(0.0, 0.0, 0.05, 5e-4)))
    assert smooth.setting.gains.feedforward == -0.05


@pytest.mark.slow
@pytest.mark.parametrize(("share", "stays"), [(0.98, True), (0.5, False)])
def test_a_running_setting_that_is_hardly_dearer_stays(share: float, stays: bool) -> None:
    policy = CertifiedPolicy(SERVO, Uncertainty(), replace(SMALL, scales=(0.5, 0.7)))
    estimate = known_gap(10.0 * DEG)
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
    gap = 25.0 * DEG
    estimate = known_gap(gap)
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
