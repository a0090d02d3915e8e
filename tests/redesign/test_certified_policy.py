"""The setting that a certified policy chooses for the evidence, and its reasons."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from servotwin.control.gains import gains_of
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.trend import Trend, TrendSettings
from servotwin.estimation.whitened.free_model import FactorPrior, adapted
from servotwin.messages import Setting
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.demands import Beyond, Demands
from servotwin.redesign.certified.policy import CertifiedPolicy, band_of
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.dead_zones import gap_range
from servotwin.redesign.policy import Evidence

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")
OWN = SERVO.controller
SMALL = Demands(machines=16, conditions=4, screened=2, settled=0.8, integral=(0.0,), beyond=Beyond(machines=4))
SHORT = Trial(duration=30.0, last=10.0)


def gaps(low: float, high: float) -> tuple[float, float]:
    return low * DEG, high * DEG


def estimated(degrees: float, std: float = 0.02, status: GapStatus = GapStatus.OK) -> GapEstimate:
    gap, spread = degrees * DEG, std * DEG
    return GapEstimate(gap, spread, spread, (gap - 2.0 * spread, gap + 2.0 * spread), status, 1.0)


def at_rest(bias: float, std: float = 1e-5, noise: float = 0.0) -> Disturbance:
    return Disturbance(bias, std, noise, 0.3, 0.0)


@pytest.fixture(scope="module")
def policy() -> CertifiedPolicy:
    return CertifiedPolicy(SERVO, Uncertainty(input_bias=(-0.1, 0.1)), SMALL)


def test_the_verification_covers_the_interval_not_the_point(policy: CertifiedPolicy) -> None:
    made = policy.redesign(Evidence(estimated(10.0, 0.5), at_rest(0.0)))
    assert made.certificate is not None
    low, high = made.certificate.gap
    assert (low, high) == pytest.approx(gap_range(estimated(10.0, 0.5)))
    assert low < 9.1 * DEG < 10.9 * DEG < high


def test_a_bias_estimated_at_rest_is_fed_forward(policy: CertifiedPolicy) -> None:
    made = policy.redesign(Evidence(estimated(10.0), at_rest(0.05, 1e-4), rests=(0.05, 0.05)))
    assert made.setting is not None
    assert made.certificate is not None
    assert made.setting.gains.feedforward == -0.05
    assert made.certificate.input_bias[0] < 0.05 < made.certificate.input_bias[1]
    assert made.setting.band == band_of(made.certificate)


def test_a_bias_beyond_what_is_stated_is_not_fed_forward_with_the_fallback_set(policy: CertifiedPolicy) -> None:
    """The voltage may be misread: the fallback set is verified as it is for every stated bias."""
    made = policy.redesign(Evidence(estimated(10.0), at_rest(-5.0), rests=(-5.0, -5.0)))
    assert made.setting is not None
    assert made.certificate == policy.fallback()
    assert made.setting.gains.feedforward == 0.0
    assert "the windows show an input bias of" in made.reason


def test_the_fallback_set_says_for_which_biases_its_feedforward_is(policy: CertifiedPolicy) -> None:
    bare = policy.fallback()
    made = policy.fall_back(Evidence(estimated(10.0), at_rest(0.04, 1e-4), rests=(0.04, 0.04)), "asked for")
    assert made.certificate is not None
    assert made.certificate.setting.controller.feedforward == -0.04
    assert made.certificate.input_bias == (bare.input_bias[0] + 0.04, bare.input_bias[1] + 0.04)
    assert made.certificate.effort == bare.effort + 0.04
    vague = policy.fall_back(Evidence(estimated(10.0), at_rest(0.04, 0.1), rests=(0.04, 0.04)), "asked for")
    assert vague.certificate == bare


def test_a_gap_beyond_the_certified_range_gets_nothing_and_a_reason(policy: CertifiedPolicy) -> None:
    made = policy.redesign(Evidence(estimated(59.9, 0.5), at_rest(0.01)))
    assert made.setting is None
    assert "at most 60 deg are certified: nothing is sent" in made.reason


def test_where_the_gap_may_only_grow_beyond_the_range_the_fallback_set_is_sent(policy: CertifiedPolicy) -> None:
    """What is in force was verified for the gap of before."""
    trend = Trend.start(0.0, TrendSettings())
    for time in range(6):
        trend = trend.update(replace(estimated(40.0 + 1.5 * time), time=10.0 * time))
    last = replace(estimated(47.5), time=50.0)
    assert gap_range(last)[1] < 60.0 * DEG < 47.5 * DEG + 200.0 * trend.rate_interval[1]
    far = replace(policy, horizon=200.0)
    made = far.redesign(Evidence(last, at_rest(0.01), trend, rests=(0.01, 0.01)))
    assert made.setting is not None
    assert structs.replace(made.setting.gains, feedforward=0.0) == gains_of(far.fallback().setting.controller)
    assert made.reason.startswith("the gap may grow to")
    assert (
        "within 200 s at the rate of wear seen and assumed ([twin.trend]), and at most 60 deg are certified; "
        "the fallback set is sent" in made.reason
    )
    again = far.redesign(Evidence(last, at_rest(0.01), trend, rests=(0.01, 0.01), setting=made.setting))
    assert again.setting is None
    assert again.reason.endswith("the fallback set stays")


@pytest.mark.slow
def test_without_a_verified_setting_the_fallback_set_is_sent_with_the_bias(policy: CertifiedPolicy) -> None:
    """The fallback set is verified for an unknown bias, without a bound on the overshoot."""
    strict = replace(policy, demands=replace(SMALL, overshoot=1e-6))
    made = strict.redesign(Evidence(estimated(10.0), at_rest(0.01), rests=(0.01, 0.01)))
    assert "none of" in made.reason
    assert "the fallback set is sent" in made.reason
    assert made.setting is not None
    assert structs.replace(made.setting.gains, feedforward=0.0) == gains_of(strict.fallback().setting.controller)
    assert made.setting.gains.feedforward == -0.01


def test_without_an_estimate_the_bias_counts_with_the_trends_gap(policy: CertifiedPolicy) -> None:
    refused = estimated(3.0, status=GapStatus.UNIDENTIFIABLE)
    assert policy.redesign(Evidence(refused, at_rest(0.05))).setting is None
    trend = Trend.start(0.0, TrendSettings()).update(estimated(10.0))
    made = policy.redesign(Evidence(refused, at_rest(0.05), trend, rests=(0.05, 0.05)))
    assert made.setting is not None
    assert made.setting.gains.feedforward == -0.05
    assert made.certificate is not None
    assert made.certificate.gap[0] < 10.0 * DEG < made.certificate.gap[1]


def test_a_setting_in_force_is_not_sent_again(policy: CertifiedPolicy) -> None:
    evidence = Evidence(estimated(10.0), at_rest(0.05))
    made = policy.redesign(evidence)
    again = policy.redesign(replace(evidence, setting=made.setting))
    assert again.setting is None
    assert "in force already" in again.reason


def test_a_changed_voltage_at_rest_indicates_friction(policy: CertifiedPolicy) -> None:
    now = OWN.replace(Ki=0.0, feedforward=-0.05)
    before = Setting(0.0, gains_of(now))
    evidence = Evidence(estimated(10.0), at_rest(0.01), None, before, tuned_for=10.0 * DEG, rests=(0.01, 0.01))
    made = policy.redesign(evidence)
    assert made.certificate is not None
    assert made.certificate.friction == pytest.approx((0.0, 0.04 * SERVO.k_T / SERVO.R))
    first = policy.redesign(replace(evidence, tuned_for=None))
    assert first.certificate is not None
    assert first.certificate.friction == (0.0, 0.0)


def test_rests_that_differ_indicate_friction_and_the_bias_between_them(policy: CertifiedPolicy) -> None:
    """Friction stops the motor at 0.06 V below the bias of 0.04 V, or above it."""
    made = policy.redesign(Evidence(estimated(10.0), at_rest(0.1), rests=(-0.02, 0.055)))
    assert made.certificate is not None
    assert made.setting.gains.feedforward == pytest.approx(-0.04)
    low, high = made.certificate.friction
    assert (low, high) == pytest.approx((0.0, 1.25 * 0.06 * SERVO.k_T / SERVO.R))
    alike = policy.redesign(Evidence(estimated(10.0), at_rest(0.06), rests=(0.0595, 0.0603)))
    assert alike.certificate is not None
    assert alike.certificate.friction == (0.0, 0.0)
    assert alike.setting.gains.feedforward == pytest.approx(-0.06)


@pytest.mark.parametrize("horizon", [20.0, 200.0])
def test_wear_until_the_horizon_widens_the_range_of_gaps(horizon: float) -> None:
    """A setting is to hold until the horizon, while the gap grows at the fastest rate that the trend allows."""
    trend = Trend.start(0.0, TrendSettings())
    for time in range(6):
        trend = trend.update(replace(estimated(4.0 + 0.01 * time), time=10.0 * time))
    assert trend.rate_interval[1] > 0.0
    last = replace(estimated(4.05), time=50.0)
    policy = CertifiedPolicy(SERVO, Uncertainty(gap=gaps(0.0, 4.06)), horizon=horizon)
    high = gap_range(last)[1] + horizon * trend.rate_interval[1]
    for one, most in ((replace(policy, horizon=horizon), high), (replace(policy, horizon=0.0), gap_range(last)[1])):
        reason = one.redesign(Evidence(last, trend=trend)).reason
        assert f"to {math.degrees(most):.3g} deg" in reason


@pytest.mark.slow
def test_a_learnt_machine_is_verified_on_what_was_learnt() -> None:
    """Damping at half the model's: candidates are judged on that machine, and the fallback set stays."""
    known = Uncertainty(gap=gaps(2, 4), step=(5e-4, 1e-3))
    policy = CertifiedPolicy(SERVO, known, SMALL, SHORT)
    factors = np.log([1.0, 0.5, 1.0, 1.0])
    learnt = FactorPrior(factors, np.diag(np.square([1e-3, 5e-3, 1e-3, 1e-3])))
    redesign = policy.redesign(Evidence(estimated(3.0), machine=learnt))
    assert redesign.certificate is not None
    law = redesign.certificate.setting.controller.replace(feedforward=0.0, enter=1.0, leave=1.0)
    machine = adapted(SERVO, factors)
    assert redesign.certificate.Ms == pytest.approx(machine.margins(law).Ms, rel=1e-9)
    assert redesign.certificate.Ms != pytest.approx(SERVO.margins(law).Ms, rel=1e-3)
    assert policy.fallback().gap == known.gap
