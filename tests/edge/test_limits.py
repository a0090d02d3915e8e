"""Bounds on gains: the box around the servo's own, and how fast they may move in it."""

from math import inf, nan
from typing import Any

import pytest
from msgspec.structs import replace

from servotwin.control import Controller
from servotwin.control.gains import gains_of
from servotwin.edge.guard import Instant, Limits, judge
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput
from servotwin.messages import Gains, Reason, Setting, Update

OWN = gains_of(Controller(Kp=1000.0, Ki=20000.0, Kd=-100.0, Tf=0.1))


def update(gains: Gains, tolerance: float = 1e-4) -> Update:
    known = (None, None, (None, None))
    return Update("axis-1", 1, 0, ("b0", 0), 9.0, *known, "OK", Setting(tolerance, gains), 60.0)


def judged(gains: Gains, limits: Limits, old: Gains = OWN, seconds: float = 10.0, tolerance: float = 1e-4) -> Reason:
    current = Parameters(setting=Setting(1e-4, old))
    here = Instant("axis-1", "b0", round(seconds * 1000), 1000.0)
    return judge(update(gains, tolerance), current, limits, here, OWN)


@pytest.mark.parametrize(
    ("changes", "inside"),
    [
        ({}, True),
        ({"Kp": 4000.0}, True),
        ({"Kp": 4001.0}, False),
        ({"Kp": 250.0}, True),
        ({"Kp": 249.0}, False),
        ({"Kp": -1000.0}, False),
        ({"Ki": 0.0}, True),
        ({"Ki": 20000.0}, True),
        ({"Ki": 20001.0}, False),
        ({"Ki": -1.0}, False),
        ({"Kd": -401.0}, False),
        ({"Kd": 100.0}, False),
        ({"Kd": 0.0}, False),
        ({"Tf": 0.5}, False),
        ({"leave": 4.0}, True),
        ({"leave": 4.1}, False),
        ({"feedforward": -0.25}, True),
        ({"feedforward": 0.26}, False),
        ({"friction_feedforward": -0.25}, True),
        ({"friction_feedforward": 0.26}, False),
        ({"velocity_feedforward": -400.0}, True),
        ({"velocity_feedforward": 401.0}, False),
        ({"velocity_feedforward": 401.0, "velocity_time": 0.2}, True),
        ({"notch_hz": 4.0}, False),
    ],
)
def test_gains_stay_in_the_box(changes: dict[str, float], inside: bool) -> None:
    expected = Reason.APPLIED if inside else Reason.GAINS_OUT_OF_BOUNDS
    assert judged(replace(OWN, **changes), Limits()) is expected


@pytest.mark.parametrize(("hertz", "inside"), [(0.0, True), (1.9, False), (2.0, True), (8.0, True), (8.1, False)])
def test_a_notch_stays_where_the_limits_allow_it(hertz: float, inside: bool) -> None:
    limits = Limits(notch_min_hz=2.0, notch_max_hz=8.0)
    expected = Reason.APPLIED if inside else Reason.GAINS_OUT_OF_BOUNDS
    assert judged(replace(OWN, notch_hz=hertz), limits) is expected


def test_a_notch_is_no_wider_than_the_limits_allow_it() -> None:
    limits = Limits(notch_max_hz=8.0, notch_damping=0.5)
    assert judged(replace(OWN, notch_hz=4.0, notch_damping=0.5), limits) is Reason.APPLIED
    assert judged(replace(OWN, notch_hz=4.0, notch_damping=0.51), limits) is Reason.GAINS_OUT_OF_BOUNDS


def test_limits_on_a_notch_are_in_order() -> None:
    with pytest.raises(InvalidInput, match=r"limits notch_min_hz = 9.0 Hz: must be at most notch_max_hz = 8.0 Hz"):
        Limits(notch_min_hz=9.0, notch_max_hz=8.0)


def test_integral_action_has_a_bound_of_its_own() -> None:
    assert judged(replace(OWN, Ki=1000.0), Limits(integral_factor=0.05)) is Reason.APPLIED
    assert judged(replace(OWN, Ki=1001.0), Limits(integral_factor=0.05)) is Reason.GAINS_OUT_OF_BOUNDS


@pytest.mark.parametrize(
    ("changes", "inside"),
    [
        ({"Kp": 500.0}, True),
        ({"Kp": 499.0}, False),
        ({"Kp": 1200.0}, True),
        ({"Kp": 1201.0}, False),  # within gain_factor
        ({"Kd": -101.0}, True),
        ({"Kd": 0.0}, True),  # of its range the part on the own side of zero counts
        ({"Kd": 1.0}, False),
        ({"Kd": -301.0}, False),
        ({"Tf": 0.4}, True),  # no range: gain_factor
        ({"Tf": 0.41}, False),
        ({"leave": 1.5}, True),
        ({"leave": 1.6}, False),
    ],
)
def test_a_gain_with_a_range_stays_in_it(changes: dict[str, float], inside: bool) -> None:
    limits = Limits(Kp=(500.0, 1200.0), Kd=(-300.0, 50.0), leave=1.5)
    expected = Reason.APPLIED if inside else Reason.GAINS_OUT_OF_BOUNDS
    assert judged(replace(OWN, **changes), limits) is expected


def test_a_step_of_a_gain_counts_from_the_lower_end_of_its_range() -> None:
    limits, least = Limits(Kp=(0.0, 1200.0), Kd=(-300.0, -50.0), gain_step=2.0), replace(OWN, Kd=-50.0)
    assert judged(replace(OWN, Kd=-100.0), limits, least) is Reason.APPLIED
    assert judged(replace(OWN, Kd=-101.0), limits, least) is Reason.GAINS_STEP_TOO_LARGE


def test_a_servo_without_integral_action_gets_none() -> None:
    own = replace(OWN, Ki=0.0)
    assert not Limits().allows_gains(replace(own, Ki=1e-6), own)
    assert Limits().allows_gains(own, own)


@pytest.mark.parametrize(
    ("old", "new", "allowed"),
    [
        ({}, {"Kp": 2000.0}, True),
        ({}, {"Kp": 2001.0}, False),
        ({}, {"Kp": 499.0}, False),
        ({}, {"Ki": 0.0}, True),  # calmer: at once
        ({"Ki": 0.0}, {"Ki": 10000.0}, True),  # twice the box's lower edge
        ({"Ki": 0.0}, {"Ki": 10001.0}, False),
        ({}, {"feedforward": 0.2}, True),
    ],
)
def test_one_update_changes_gains_by_a_factor_at_most(
    old: dict[str, float], new: dict[str, float], allowed: bool
) -> None:
    reason = judged(replace(OWN, **new), Limits(gain_step=2.0), replace(OWN, **old))
    assert reason is (Reason.APPLIED if allowed else Reason.GAINS_STEP_TOO_LARGE)


def test_the_allowed_factor_grows_with_time() -> None:
    limits = Limits(gain_rate=1.1)
    faster = replace(OWN, Kp=1200.0)
    assert judged(faster, limits, seconds=9.0) is Reason.APPLIED
    current = Parameters(setting=Setting(1e-4, OWN), sample=8200)
    here = Instant("axis-1", "b0", 10_000, 1000.0)  # 1.1 ** 1.8 = 1.187
    assert judge(update(faster), current, limits, here, OWN) is Reason.GAINS_STEP_TOO_LARGE
    assert Limits(gain_rate=1e300).allows_gains_step(OWN, replace(OWN, Kp=4000.0), OWN, 9e9)


def test_the_tolerance_has_a_speed_limit() -> None:
    limits = Limits(max_rate=1e-5)
    assert judged(OWN, limits, tolerance=1.9e-4) is Reason.APPLIED
    assert judged(OWN, limits, tolerance=2.1e-4) is Reason.STEP_TOO_LARGE


@pytest.mark.parametrize(
    "values",
    [
        {"gain_factor": 0.9}, {"gain_step": 0.0}, {"gain_rate": nan}, {"feedforward": -0.1}, {"feedforward": nan},
        {"patience_s": -1.0}, {"patience_s": inf}, {"max_rate": 0.0},
        {"integral_factor": -1.0}, {"Kp": (2.0, 1.0)}, {"Kp": (nan, 1.0)}, {"leave": -1.0},
    ],
)  # fmt: skip
def test_bad_limits_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match="limits"):
        Limits(**values)
