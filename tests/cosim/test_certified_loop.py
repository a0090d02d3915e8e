"""The packaged scenario `certified`: the default twin in the loop, with wear and a bias on the motor's input."""

import math
from functools import cache

import numpy as np
import pytest
from few_machines import FEW, certified_scenario

from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Recording, Scenario
from servotwin.estimation.estimate import GapStatus
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.verification import verification_of
from servotwin.redesign.registry import certified_policy
from servotwin.twin.settings import TwinSettings

LEARNT = 20.0  # s, the second step begins


LENGTH = 60.0  # s: three steps; the demonstration's test runs all ten


@cache
def loop() -> Loop:
    return cosimulate(Scenario.preset("certified").replace(duration=LENGTH))


@pytest.mark.slow
def test_it_is_fig15s_wear_under_the_default_policy():
    fig15, scenario = Scenario.preset("fig15"), Scenario.preset("certified")
    assert (scenario.reference, scenario.gap, scenario.duration) == (fig15.reference, fig15.gap, fig15.duration)
    assert scenario.uplink == fig15.uplink
    assert (scenario.twin.policy, scenario.input_bias) == ("certified", 0.05)


@pytest.mark.slow
def test_estimates_are_right_or_refused():
    truth = loop().scenario.gap
    good = [e for e in loop().estimates if e.status is GapStatus.OK]
    assert len(good) >= 3
    for estimate in good:
        assert abs(estimate.gap - float(truth.pieces(200.0).value([estimate.time])[0])) < math.radians(0.05)


@pytest.mark.slow
def test_updates_are_applied_and_the_bias_is_learnt():
    assert len(loop().applied) == len(loop().updates) >= 1
    assert {receipt.version for receipt in loop().applied} == {update.version for update in loop().updates}
    # The motor's motion told bias and friction apart in the first window already.
    for update in loop().updates:
        assert abs(update.setting.gains.feedforward + loop().scenario.input_bias) < 1e-3


@pytest.mark.slow
def test_the_loop_stays_and_what_was_verified_holds():
    assert not loop().fallbacks
    run = loop().run
    for begin in np.arange(LEARNT, LENGTH, 20.0):
        tail = slice(round((begin + 10.0) * run.sample_rate), round((begin + 20.0) * run.sample_rate))
        assert np.abs(run.reference[tail] - run.position[tail]).max() < 5e-6


@pytest.mark.exploration
def test_the_published_controller_does_not_settle_on_the_same_machine():
    """Neither with the published rule, nor with the twin switched off; the suite sees it in the demonstration."""
    published = Scenario.preset("fig15").replace(input_bias=0.05)
    for scenario in (published, published.replace(twin=published.twin.replace(enabled=False))):
        run = cosimulate(scenario.replace(duration=100.0)).run
        last = slice(round(90.0 * run.sample_rate), None)
        assert np.ptp(run.position[last]) > 1e-4


@pytest.mark.slow
def test_evidence_goes_with_the_update_and_stays_in_the_store():
    sent = [redesign for redesign in loop().redesigns if redesign.setting is not None]
    for update, redesign in zip(loop().updates, sent, strict=True):
        assert isinstance(redesign.certificate, Certificate)
        assert update.verification == verification_of(redesign.certificate)
        assert update.verification.members == 300
        assert update.verification.settled >= 0.99
        assert update.verification.Ms <= 2.0
        assert update.setting.band == redesign.setting.band


@pytest.mark.slow
def test_the_same_scenario_gives_the_same_bytes():
    """A certificate's wall time goes nowhere."""
    short = certified_scenario(10.0)
    first, second = cosimulate(short), cosimulate(short)
    assert first.updates
    assert first.digest() == second.digest()


@pytest.mark.slow
def test_without_a_twin_the_edge_stays_on_what_is_verified_for_every_gap():
    scenario = Scenario.preset("certified")
    alone = cosimulate(scenario.replace(duration=60.0, twin=scenario.twin.replace(enabled=False)))
    fallback_certificate = certified_policy(scenario.model, scenario.twin).fallback()
    assert not alone.fallbacks
    error = np.abs(alone.run.reference - alone.run.position)
    settled = slice(round(55.0 * alone.run.sample_rate), -1)
    setting = fallback_certificate.setting
    assert setting.controller.integral_only
    # The integral takes the bias, but for the zone in which it stops; proportional action alone would leave more.
    within = setting.controller.leave * setting.tolerance
    assert error[settled].max() <= within < 0.5 * scenario.input_bias / setting.controller.Kp
    assert fallback_certificate.tail < fallback_certificate.within


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "updates"), [("margin", 3), ("hysteresis", 1)])
def test_the_other_policies_close_the_loop_too(policy, updates):
    """What hysteresis sends passes the limits that are made for it, and is not sent again for a gap that stays."""
    scenario = Scenario.preset("fig15").replace(
        duration=45.0, gap=math.radians(10.0), recording=Recording(), twin=TwinSettings(policy=policy)
    )
    found = cosimulate(scenario)
    assert len(found.applied) == len(found.updates) == updates
    assert not found.fallbacks
    error = np.abs(found.run.reference - found.run.position)
    assert error[round(30.0 * found.run.sample_rate) : round(40.0 * found.run.sample_rate) - 1].max() < 0.1e-3


@pytest.mark.slow
def test_noise_and_a_loop_filter_are_no_reason_to_fall_back():
    found = cosimulate(Scenario.preset("fig16").replace(duration=25.0, twin=TwinSettings(demands=FEW)))
    assert not found.fallbacks
    assert len(found.applied) == len(found.updates) >= 1
