"""The paper's estimator on prescribed windows: what it finds, what it refuses, and what it says of bad input."""

import math
from functools import partial

import numpy as np
import pytest
from exploration import explored
from hypothesis import given
from hypothesis import strategies as st
from measured_windows import RATE, measured

from servotwin.errors import InvalidInput
from servotwin.estimation import gap as entry
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.paper.estimator import PaperSettings
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo

estimate_gap = partial(entry.estimate_gap, method="paper")

SERVO = Servo.preset("paper")
PATIENT = PaperSettings(settle_s=0.5)
T = np.arange(10000) / RATE


def trembling(t):
    return math.radians(0.4) * np.sin(2.0 * np.pi * 3.0 * t)


def slow(t):
    """A motor that turns round once and comes back by 4 deg only."""
    return np.interp(t, [0.0, 1.7, 1.9, 3.0], [0.0, 6.0, 5.93, 5.93])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap_deg", "prior_deg"), [(0.5, 40.0), (3.0, 0.0), (10.0, 8.0), (25.0, 8.0), (60.0, 0.0), (60.0, 40.0)]
)
def test_finds_the_gap_once_the_observer_has_settled(gap_deg, prior_deg):
    estimate = estimate_gap(measured(math.radians(gap_deg)), SERVO, prior=math.radians(prior_deg), settings=PATIENT)
    assert estimate.status is GapStatus.OK
    assert math.degrees(estimate.gap) == pytest.approx(gap_deg, abs=2e-3)
    assert estimate.interval[0] < math.radians(gap_deg) < estimate.interval[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "servo",
    explored(
        [
            Servo.preset("table1"),
            SERVO.replace(n=2),
            SERVO.replace(n=5, k=(1.0, 2e4, 3e4, 2e4, 4e4), m=2.0),
            SERVO.replace(k_d=1e6),
        ],
        *(1, 2, 3),
    ),
)
def test_finds_the_gap_of_other_servos(servo):
    settings = PaperSettings(settle_s=0.5, alpha=60.0)
    estimate = estimate_gap(measured(math.radians(10.0), servo), servo, settings=settings)
    assert math.degrees(estimate.gap) == pytest.approx(10.0, abs=0.02)


@pytest.mark.slow
def test_an_estimate_names_its_model_and_method():
    window = measured(math.radians(10.0))
    estimate = estimate_gap(window, SERVO, prior=math.radians(9.0))
    assert estimate.ok
    assert estimate.time == window.mid_time
    assert estimate.model_version == SERVO.version == SERVO.replace(Kp=1.0).version != SERVO.replace(k=9e3).version
    assert (estimate.method, estimate.reasons) == ("paper", ())
    assert 0.0 < estimate.std < estimate.std_total < math.radians(2.0)
    assert estimate.interval[0] < estimate.gap < estimate.interval[1]
    assert abs(estimate.theta_d0 - window.theta_m[0]) <= 0.5 * estimate.gap * (1.0 + 1e-12)
    assert 0.0 < estimate.rms < 1e-4
    assert estimate.evaluations > 1


@pytest.mark.parametrize("scale", [2.0**-3, 2.0, 2.0**6])
def test_scaling_every_signal_scales_the_estimate_bit_for_bit(scale):
    window = measured(math.radians(10.0))
    larger = Window(scale * window.position, scale * window.theta_m, sample_rate=RATE, start=window.start)
    open_minded = PaperSettings(largest_std=1e3)
    one = estimate_gap(window, SERVO, prior=0.1, settings=open_minded)
    other = estimate_gap(larger, SERVO, prior=scale * 0.1, settings=open_minded)
    assert (other.gap, other.theta_d0, other.std, other.rms) == tuple(
        scale * v for v in (one.gap, one.theta_d0, one.std, one.rms)
    )


@pytest.mark.slow
def test_gaps_of_zero_come_out_as_zero_not_below():
    found = [estimate_gap(measured(0.0, start=start), SERVO) for start in (1.1, 1.3)]
    assert all(estimate.ok for estimate in found)
    assert all(0.0 <= estimate.gap < math.radians(1.0) for estimate in found)
    assert (
        [bool(estimate.reasons) for estimate in found] == [estimate.gap == 0.0 for estimate in found] == [False, True]
    )


def test_an_estimate_is_a_prior_and_one_that_failed_is_none():
    window = measured(math.radians(10.0))
    good = estimate_gap(window, SERVO, settings=PATIENT)
    assert estimate_gap(window, SERVO, prior=good).gap == estimate_gap(window, SERVO, prior=good.gap).gap
    bad = GapEstimate(math.nan, math.inf, math.inf, (0.0, math.inf), GapStatus.UNIDENTIFIABLE, 0.0)
    assert estimate_gap(window, SERVO, prior=bad) == estimate_gap(window, SERVO)


@pytest.mark.parametrize(
    ("theta_m", "reason"),
    [
        (np.zeros(5000), "never moved faster than 0.1 rad/s"),
        (1e-4 * np.sin(300.0 * T[:5000]), "never moved faster than 0.1 rad/s"),
        (3.0 * T[:5000], "changed direction 0 times, and 1 are needed"),
    ],
)
def test_without_motion_or_reversal_nothing_is_known(theta_m, reason):
    estimate = estimate_gap(Window(SERVO.p * theta_m, theta_m, sample_rate=RATE), SERVO, prior=0.1)
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert math.isnan(estimate.gap)
    assert math.isnan(estimate.theta_d0)
    assert estimate.interval == (0.0, math.inf)
    assert estimate.std == estimate.std_total == math.inf
    assert reason in estimate.reasons[0]


@pytest.mark.slow
@pytest.mark.parametrize("gap_deg", explored([5.0, 10.0, 30.0], 0, 2))
def test_one_contact_gives_a_lower_bound(gap_deg):
    """The motor turns back by 4 deg within the gap: it is at least as wide as that."""
    estimate = estimate_gap(measured(math.radians(gap_deg), motor=slow), SERVO, settings=PATIENT)
    assert estimate.status is GapStatus.LOWER_BOUND
    assert math.degrees(estimate.gap) == pytest.approx(math.degrees(0.07), abs=0.1)
    assert estimate.interval[0] <= estimate.gap < math.radians(gap_deg)
    assert estimate.interval[1] == math.inf
    assert "needed both ways" in estimate.reasons[0]


@pytest.mark.slow
def test_a_motion_smaller_than_the_spread_shows_no_gap():
    """0.8 deg to and fro within a gap of 3 deg, or in contact without any: too little to tell."""
    estimate = estimate_gap(measured(0.0, motor=trembling), SERVO)
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert "the motor moved by 0.8 deg, less than the" in estimate.reasons[0]
    assert not estimate_gap(measured(math.radians(3.0), motor=trembling), SERVO).ok


def spoiled(window, **channels):
    kept = {"position": window.position, "theta_m": window.theta_m, **channels}
    return Window(**kept, sample_rate=RATE)


@pytest.mark.parametrize("spoil", ["sign", "dead", "swapped", "scale", "noise"])
def test_a_window_of_another_machine_gets_no_number(spoil):
    window = measured(math.radians(10.0))
    position, theta_m = window.position, window.theta_m
    bad = {
        "sign": {"position": -position},
        "dead": {"position": np.full(5000, position[0])},
        "swapped": {"position": theta_m, "theta_m": position},
        "scale": {"position": 3.0 * position},
        "noise": {"position": np.random.default_rng(0).standard_normal(5000) * 1e-3},
    }[spoil]
    estimate = estimate_gap(spoiled(window, **bad), SERVO, prior=0.15)
    assert not estimate.ok
    assert math.isnan(estimate.gap)
    assert estimate.reasons


def test_an_estimate_too_uncertain_is_refused():
    window = measured(math.radians(10.0))
    estimate = estimate_gap(window, SERVO, settings=PaperSettings(largest_std=1e-6))
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert "deg are allowed" in estimate.reasons[0]


def test_a_minimisation_cut_short_is_refused():
    estimate = estimate_gap(measured(math.radians(10.0)), SERVO, settings=PaperSettings(iterations=1))
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert "did not converge" in estimate.reasons[0]


@given(st.integers(0, 2**31))
def test_a_number_is_never_confident_without_evidence(seed):
    """Random walks of both channels, unrelated: whatever is accepted would be wrong."""
    rng = np.random.default_rng(seed)
    theta_m, position = np.cumsum(rng.standard_normal((2, 3000)), axis=1)
    estimate = estimate_gap(Window(1e-4 * position, 0.1 * theta_m, sample_rate=RATE), SERVO)
    assert not estimate.ok


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "magic"}, "method 'magic' does not exist: allowed are whitened, paper"),
        ({"prior": -0.1}, "prior = -0.1 rad: must be a finite total gap of at least 0"),
        ({"prior": math.nan}, "prior = nan rad"),
        ({"settings": {"alpha": 40.0}}, "do not belong to method 'paper'"),
        (
            {"settings": PaperSettings(lowpass_hz=2500.0)},
            "lowpass_hz = 2500.0 Hz: must be below half the sample rate of 5000 Hz",
        ),
        (
            {"settings": PaperSettings(settle_s=0.999)},
            r"lasts 1 s: must be at least 1\.0022 s, so that the observer can settle",
        ),
    ],
)
def test_bad_requests_are_one_sentence(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        estimate_gap(measured(math.radians(10.0)), SERVO, **arguments)


def test_the_motor_angle_is_needed():
    with pytest.raises(InvalidInput, match="log: the window has no theta_m"):
        estimate_gap(Window(np.zeros(5000), sample_rate=RATE, source="log"), SERVO)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"alpha": 0.0}, "alpha = 0.0 rad/s: must be a positive number, finite"),
        ({"alpha": math.inf}, "alpha = inf"),
        ({"settle_s": -1.0}, "settle_s = -1.0 s: must be a number, at least 0, finite"),
        ({"lowpass_order": 2.5}, "lowpass_order = 2.5: must be an integer, at least 1"),
        ({"reversals": True}, "reversals = True: must be an integer, at least 0"),
        ({"rest_speed": -0.1}, "rest_speed = -0.1 rad/s: must be a number, at least 0, finite"),
        ({"padding": "none"}, "padding = 'none': must be one of odd, even"),
        ({"origin": "zero"}, "origin = 'zero': must be one of absolute, first"),
    ],
)
def test_settings_are_checked(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        PaperSettings(**arguments)
