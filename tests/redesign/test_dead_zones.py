"""Dead zones from the gap with a margin, with hysteresis, and from the map of what settles."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.messages import Setting
from servotwin.plant.servo import Servo
from servotwin.redesign.dead_zones import HysteresisPolicy, MarginPolicy, gap_range
from servotwin.redesign.policy import Evidence
from servotwin.redesign.settling import settling_map
from servotwin.simulation import simulate

DEG = math.pi / 180.0
SERVO = Servo.preset("paper")


def estimated(degrees: float, std: float = 0.02, status: GapStatus = GapStatus.OK) -> GapEstimate:
    gap, spread = degrees * DEG, std * DEG
    return GapEstimate(gap, spread, spread, (gap - 2.0 * spread, gap + 2.0 * spread), status, 1.0)


def at_rest(bias: float, std: float = 1e-5, noise: float = 0.0) -> Disturbance:
    return Disturbance(bias, std, noise, 0.3, 0.0)


@pytest.mark.slow
def test_the_margin_policy_takes_the_wider_of_gap_and_noise() -> None:
    rule = MarginPolicy(SERVO, step=(1e-4, 1e-3))
    wide = rule.redesign(Evidence(estimated(10.0)))
    unit = SERVO.tolerance_for(gap_range(estimated(10.0))[1])
    assert wide.setting.tolerance == pytest.approx(settling_map(SERVO).least(1e-4 / unit, 1e-3 / unit) * unit)
    noisy = rule.redesign(Evidence(estimated(0.1), at_rest(0.0, noise=1e-3)))
    assert noisy.setting.tolerance == pytest.approx(3e-3)
    assert rule.redesign(Evidence(estimated(1.0, status=GapStatus.LOWER_BOUND))).setting is None


@pytest.mark.slow
def test_the_settling_map_holds_for_every_gap() -> None:
    """Homogeneity: a cell of the map, simulated at another gap."""
    found = settling_map(SERVO)
    least = found.least(2.0, 5.0)
    gap = 7.0 * DEG
    unit = SERVO.p * gap
    for step, place in ((2.0, -0.4), (5.0, 0.3)):
        run = simulate(
            SERVO, 60.0, reference=step * unit, gap=gap, tolerance=least * unit, theta_d0=place * gap, sample_rate=100.0
        )
        assert 0.5 * np.ptp(run.position[-2000:]) < 1e-3 * unit
    assert found.settled[0].mean() < 0.1
    assert found.least(2.0, 5.0) >= found.least(4.0, 5.0)


def test_hysteresis_enters_inside_and_leaves_outside() -> None:
    made = HysteresisPolicy(SERVO).redesign(Evidence(estimated(10.0)))
    assert made.setting is not None
    assert (made.setting.gains.enter, made.setting.gains.leave) == (0.5, 1.5)
    assert made.setting.tolerance == SERVO.tolerance_for(10.0 * DEG)


def test_hysteresis_sends_nothing_while_the_dead_zone_in_force_fits_the_estimate() -> None:
    """A gap that stays sends one setting; wear, other gains and an unknown setting send one again."""
    rule = HysteresisPolicy(SERVO)
    sent = rule.redesign(Evidence(estimated(10.0))).setting
    spread = gap_range(estimated(10.0))[1] / DEG - 10.0
    for gap in (10.0, 10.0 + 0.9 * spread, 10.0 - 0.9 * spread):
        again = rule.redesign(Evidence(estimated(gap), setting=sent))
        assert again.setting is None
        assert again.gap == gap * DEG
        assert again.reason == "the dead zone in force is that of a gap in the estimate's interval"
    for gap in (10.0 + 1.1 * spread, 10.0 - 1.1 * spread):
        assert rule.redesign(Evidence(estimated(gap), setting=sent)).setting.tolerance == SERVO.tolerance_for(gap * DEG)
    others = (Setting(sent.tolerance), Setting.of(sent.tolerance, msgspec.structs.replace(sent.gains, leave=2.0)))
    for other in others:
        assert rule.redesign(Evidence(estimated(10.0), setting=other)).setting == sent
