"""Eq 21, and what never reaches a controller."""

import math
from dataclasses import replace

import pytest

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.plant.servo import Servo
from servotwin.redesign.policy import Evidence, PaperPolicy

SERVO = Servo.preset("paper")
GOOD = GapEstimate(0.2, 0.01, 0.02, (0.16, 0.24), GapStatus.OK, 0.5)


def test_the_tolerance_is_the_gap_times_pitch_and_gain():
    made = PaperPolicy(SERVO, k_dz=1.5).redesign(Evidence(GOOD, tuned_for=0.1))
    assert made.setting.tolerance == pytest.approx(1.5 * SERVO.p * 0.2, rel=1e-15)
    assert (made.gap, made.reason) == (0.2, "")


def test_smoothing_keeps_a_share_of_the_previous_gap():
    policy = PaperPolicy(SERVO, smoothing=0.1)
    assert policy.redesign(Evidence(GOOD, tuned_for=0.1)).gap == pytest.approx(0.19, rel=1e-15)
    assert policy.redesign(Evidence(GOOD)).gap == pytest.approx(0.2, rel=1e-15)


@pytest.mark.parametrize("status", [status for status in GapStatus if status is not GapStatus.OK])
def test_only_estimates_that_are_ok_set_a_tolerance(status):
    made = PaperPolicy(SERVO).redesign(Evidence(replace(GOOD, status=status, reasons=("the motor rested",))))
    assert made.setting is None
    assert math.isnan(made.gap)
    assert made.reason == f"the estimate is {status.value}: the motor rested"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"k_dz": -1.0}, "k_dz = -1.0"),
        ({"k_dz": math.inf}, "k_dz = inf"),
        ({"smoothing": 1.0}, "smoothing = 1.0: must be at least 0 and below 1"),
        ({"smoothing": math.nan}, "smoothing = nan"),
    ],
)
def test_settings_are_checked(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        PaperPolicy(SERVO, **arguments)
