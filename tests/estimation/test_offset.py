"""The encoder's offset: shifts of the encoder, its spread in noise, and the trend that carries it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.learning.trend import Trend, TrendSettings
from servotwin.estimation.whitened import read_offset
from servotwin.estimation.whitened.estimator import WhitenedSettings
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import Run, simulate

SERVO, FLOOR = Servo.preset("paper"), 1e-6


@pytest.fixture(scope="module")
def wearing() -> Run:
    gap = SCurve(math.radians(4.0), math.radians(12.0), 80.0)
    return simulate(SERVO, 61.1, reference=SquareWave(1e-3, 20.0), gap=gap)


def seen(run: Run, start: float, shift: float = 0.0, seed: int = 0) -> Window:
    window = Window.from_run(run, start, 1.0)
    noise = FLOOR * np.random.default_rng(seed).standard_normal(window.position.size)
    return window.replace(position=window.position + noise, theta_m=window.theta_m + shift)


@pytest.mark.parametrize("shift_deg", [0.0, 7.0, -300.0])
def test_a_shifted_encoder_is_read(wearing, shift_deg):
    """The encoder shows `shift` too much, so the screw that the position tells of lies that much lower."""
    window = seen(wearing, 20.0, math.radians(shift_deg))
    estimate = estimate_gap(window, SERVO)
    found = read_offset(window, SERVO, estimate)
    assert abs(math.degrees(found.offset) + shift_deg) < 5.0 * math.degrees(found.std) + 1e-3
    assert abs(found.covariance) <= found.std * estimate.std_total * (1.0 + 1e-9)


@pytest.mark.slow
def test_its_spread_is_that_of_many_readings(wearing):
    errors, stated = [], []
    for seed in range(30):
        window = seen(wearing, 10.0, seed=seed)
        estimate = estimate_gap(window, SERVO)
        found = read_offset(window, SERVO, estimate)
        errors.append((found.offset, estimate.gap))
        stated.append((found.std * estimate.std / estimate.std_total, estimate.std))
    assert np.std(errors, axis=0) == pytest.approx(np.mean(stated, axis=0), rel=0.5)


def test_the_trend_carries_gap_and_offset(wearing):
    """Steps every 10 s of a wearing gap: the state follows both, and its prior contains the next window's answer."""
    trend, shift = Trend.start(0.0, TrendSettings.for_wear(math.radians(12.0), 80.0)), math.radians(5.0)
    for index, start in enumerate(np.arange(10.0, 61.0, 10.0)):
        window = seen(wearing, start, shift, index)
        ahead = trend.predict(window.mid_time)
        settings = WhitenedSettings(
            gap_rate=math.radians(0.2), offset=(ahead.prior.offset, ahead.prior.offset_std) if index else None
        )
        estimate = estimate_gap(window, SERVO, prior=ahead.as_estimate() if index else None, settings=settings)
        assert estimate.ok, estimate.reasons
        truth = wearing.gap[round(window.mid_time * 5000)]
        if index > 1:
            assert abs(truth - ahead.prior.gap) < 3.5 * ahead.prior.gap_std
        trend = trend.update(estimate, read_offset(window, SERVO, estimate))
        assert abs(truth - trend.gap) < 4.0 * trend.gap_std
    assert trend.updates == 6
    assert math.degrees(trend.prior.offset) == pytest.approx(-5.0, abs=0.03)
    assert trend.rate == pytest.approx((wearing.gap[-1] - wearing.gap[-50_001]) / 10.0, abs=2.5 * trend.rate_std)
    limit = trend.time_until(math.radians(20.0))
    assert limit.interval[0] < limit.median < limit.interval[1]


def test_what_is_missing_is_named(wearing):
    window = seen(wearing, 20.0)
    refused = replace(estimate_gap(window, SERVO), status=GapStatus.LOWER_BOUND)
    with pytest.raises(InvalidInput, match="OK estimate"):
        read_offset(window, SERVO, refused)
    with pytest.raises(InvalidInput, match="theta_m"):
        read_offset(Window(window.position, sample_rate=5000.0), SERVO, refused)
