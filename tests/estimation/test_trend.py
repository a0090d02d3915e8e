"""The Kalman filter across windows against batch least squares, its invariants, and its coverage on simulated wear."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import CarriedOffset, GapEstimate, GapStatus, OffsetReading
from servotwin.estimation.learning.trend import Trend, TrendSettings, process_noise, transition, truncation

DEG = math.radians(1.0)
SETTINGS = TrendSettings(
    gap_std_rad=1.0,
    rate_std_rad_per_s=0.02,
    offset_std_rad=0.5,
    gap_walk_rad_per_sqrt_s=1e-3,
    rate_walk_rad_per_s_per_sqrt_s=2e-4,
    offset_walk_rad_per_sqrt_s=5e-4,
    shared_error_rad=0.0,
    outlier_std=1e9,
)


def seen(time: float, gap: float, std: float, status: GapStatus = GapStatus.OK) -> GapEstimate:
    low = max(0.0, gap - 1.959963984540054 * std)
    return GapEstimate(
        gap, std, std, (low, gap + 2.0 * std), status, time, reasons=("because",) if status != "ok" else ()
    )


def batch(times, gaps, stds, offsets, offset_stds, settings):
    """Mean and covariance of the last state by least squares over all states at once: nothing recursive in it."""
    count = len(times)
    rows, right = [], []

    def add(block: np.ndarray, value: np.ndarray, covariance: np.ndarray) -> None:
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(whiten @ block)
        right.append(whiten @ value)

    first = np.zeros((3, 3 * count))
    first[:, :3] = np.eye(3)
    start = Trend.start(times[0], settings).covariance
    add(first, np.zeros(3), start)
    for i in range(1, count):
        step = times[i] - times[i - 1]
        link = np.zeros((3, 3 * count))
        link[:, 3 * i : 3 * i + 3] = np.eye(3)
        link[:, 3 * i - 3 : 3 * i] = -transition(step)
        add(link, np.zeros(3), process_noise(step, settings))
    for i in range(count):
        look = np.zeros((2, 3 * count))
        look[0, 3 * i], look[1, 3 * i + 2] = 1.0, 1.0
        add(look, np.array([gaps[i], offsets[i]]), np.diag([stds[i] ** 2, offset_stds[i] ** 2]))
    A, b = np.vstack(rows), np.concatenate(right)
    covariance = np.linalg.inv(A.T @ A)
    return (covariance @ (A.T @ b))[-3:], covariance[-3:, -3:]


def test_equal_to_batch_least_squares():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(1.0, 40.0, 12))
    gaps, stds = rng.normal(0.2, 0.05, 12), rng.uniform(1e-3, 3e-2, 12)
    offsets, offset_stds = rng.normal(0.0, 0.1, 12), rng.uniform(1e-2, 1e-1, 12)
    trend = Trend.start(times[0], SETTINGS)
    for values in zip(times, gaps, stds, offsets, offset_stds, strict=True):
        trend = trend.update(seen(*values[:3]), OffsetReading(values[3], values[4]))
    mean, covariance = batch(times, gaps, stds, offsets, offset_stds, SETTINGS)
    np.testing.assert_allclose(trend.mean, mean, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(trend.covariance, covariance, rtol=1e-8, atol=1e-14)
    assert trend.updates == 12


def test_correlated_offset_is_one_least_squares_problem():
    trend, noise = Trend.start(0.0, SETTINGS), np.array([[4e-4, 1.5e-4], [1.5e-4, 1e-4]])
    found = trend.update(seen(0.0, 0.3, 0.02), OffsetReading(0.1, 0.01, 1.5e-4))
    prior = trend.covariance[np.ix_([0, 2], [0, 2])]
    expected = np.linalg.inv(np.linalg.inv(prior) + np.linalg.inv(noise))
    np.testing.assert_allclose(found.covariance[np.ix_([0, 2], [0, 2])], expected, rtol=1e-9)
    np.testing.assert_allclose(found.mean[[0, 2]], expected @ np.linalg.solve(noise, [0.3, 0.1]), rtol=1e-9)


@given(st.lists(st.tuples(st.floats(0.0, 50.0), st.floats(0.0, 1.0), st.floats(1e-6, 1.0)), min_size=1, max_size=15))
def test_the_covariance_stays_a_covariance_and_windows_only_sharpen(windows):
    trend, time = Trend.start(0.0, SETTINGS), 0.0
    for step, gap, std in windows:
        time += step
        before, trend = trend.predict(time), trend.update(seen(time, gap, std))
        assert np.array_equal(trend.covariance, trend.covariance.T)
        assert np.linalg.eigvalsh(trend.covariance).min() > 0.0
        assert trend.covariance[0, 0] <= min(before.covariance[0, 0], std**2) * (1.0 + 1e-9)
        assert np.linalg.eigvalsh(before.covariance - trend.covariance).min() >= -1e-9 * before.covariance.max()


@given(st.floats(0.0, 1e4), st.floats(0.0, 1.0))
def test_a_prediction_may_be_split(step, share):
    trend = Trend.start(0.0, SETTINGS).update(seen(0.0, 0.2, 0.01))
    whole, halves = trend.predict(step), trend.predict(step * share).predict(step)
    np.testing.assert_allclose(halves.mean, whole.mean, rtol=1e-9)
    np.testing.assert_allclose(halves.covariance, whole.covariance, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_units_do_not_matter(angle, clock):
    """Angles times `angle`, times times `clock`: the settings carry their units, so every answer scales with them."""

    def run(a: float, c: float) -> Trend:
        made = TrendSettings.for_wear(0.3 * a, 100.0 * c, gap_std_rad=a, offset_std_rad=a, shared_error_rad=1e-3 * a)
        trend = Trend.start(0.0, made)
        for k in range(5):
            trend = trend.update(seen(20.0 * c * k, (0.05 + 0.02 * k) * a, 0.004 * a))
        return trend

    one, other = run(1.0, 1.0), run(angle, clock)
    assert other.gap == pytest.approx(one.gap * angle)
    assert other.rate_std == pytest.approx(one.rate_std * angle / clock)
    assert other.time_until(0.5 * angle).median == pytest.approx(one.time_until(0.5).median * clock, rel=1e-6)


def wearing(rng, settings, count, spacing, std):
    """A truth drawn from the filter's own model, and what windows show of it."""
    state = np.array([1.0, rng.normal(0.0, settings.rate_std_rad_per_s), 0.0])
    root = np.linalg.cholesky(process_noise(spacing, settings) + 1e-30 * np.eye(3))
    for k in range(count):
        yield state, seen(k * spacing, state[0] + std * rng.standard_normal(), std)
        state = transition(spacing) @ state + root @ rng.standard_normal(3)


def test_intervals_cover_simulated_wear():
    settings = TrendSettings(
        rate_std_rad_per_s=1e-3, rate_walk_rad_per_s_per_sqrt_s=3e-5, shared_error_rad=0.0, gap_std_rad=1.0
    )
    rng, inside = np.random.default_rng(11), []
    for _ in range(400):
        trend = Trend.start(0.0, settings)
        truth = np.zeros(3)
        for truth, estimate in wearing(rng, settings, 10, 20.0, 2e-3):  # noqa: B007
            trend = trend.update(estimate)
        gap, rate = trend.gap_interval, trend.rate_interval
        inside.append([gap[0] <= truth[0] <= gap[1], rate[0] <= truth[1] <= rate[1]])
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.95) < 0.03)


@pytest.mark.slow
def test_the_time_to_a_limit_covers_when_wear_reaches_it():
    """Constant rates: the truth's arrival lies in the 95 % interval in 95 % of the cases."""
    settings = TrendSettings(rate_std_rad_per_s=5e-3, rate_walk_rad_per_s_per_sqrt_s=0.0, shared_error_rad=0.0)
    rng, inside = np.random.default_rng(5), []
    for _ in range(300):
        rate, trend = rng.normal(0.0, 5e-3), Trend.start(0.0, settings)
        for k in range(6):
            trend = trend.update(seen(20.0 * k, 0.3 + rate * 20.0 * k + 5e-2 * rng.standard_normal(), 5e-2))
        now = 0.3 + rate * 100.0
        arrival = 0.0 if now >= 0.6 else (0.6 - now) / rate if rate > 0.0 else math.inf
        low, high = trend.time_until(0.6).interval
        inside.append(low <= arrival <= high)
    assert 0.91 < np.mean(inside) < 0.99


def test_follows_the_papers_wear():
    """0 to 20 deg as an S-curve over 200 s, a window every 20 s good to 0.02 deg: predictions 20 s ahead."""
    rng, trend = np.random.default_rng(2), Trend.start(0.0, TrendSettings())
    scores = []
    for time in np.arange(0.5, 200.0, 20.0):
        u = time / 200.0
        truth = 20.0 * DEG * (3.0 * u**2 - 2.0 * u**3)
        ahead = trend.predict(time)
        scores.append((truth - ahead.mean[0]) / ahead.gap_std)
        trend = trend.update(seen(time, truth + 0.02 * DEG * rng.standard_normal(), 0.02 * DEG))
        assert abs(trend.gap - truth) < 0.06 * DEG
    assert np.max(np.abs(scores)) < 3.0
    assert trend.reasons == ()


def test_shared_error_is_not_averaged_away():
    trend = Trend.start(0.0, TrendSettings(shared_error_rad=0.02 * DEG, rate_walk_rad_per_s_per_sqrt_s=0.0))
    for k in range(400):
        trend = trend.update(seen(20.0 * k, 0.2, 0.02 * DEG))
    assert 0.02 * DEG < trend.gap_std < 0.021 * DEG
    assert trend.rate_std < 1e-4 * DEG


def test_a_lower_bound_moves_only_what_lies_below_it():
    trend = Trend.start(0.0, SETTINGS).update(seen(0.0, 0.2, 0.05))
    slack = trend.update(seen(0.0, 0.01, 0.005, GapStatus.LOWER_BOUND))
    assert slack.gap == pytest.approx(trend.gap, abs=1e-4)
    pushed = trend.update(seen(0.0, 0.3, 0.005, GapStatus.LOWER_BOUND))
    assert trend.gap < pushed.gap
    assert pushed.gap_std < trend.gap_std
    assert pushed.updates == trend.updates
    assert "lower bound" in pushed.reasons[0]


@pytest.mark.slow
@given(st.floats(-30.0, 30.0))
def test_truncated_moments_are_those_of_a_cut_normal(margin):
    pull, cut = truncation(margin)
    if margin > -8.0:
        grid = np.linspace(-margin, -margin + 40.0, 400_001) if margin > -8 else None
        weight = norm.pdf(grid)
        mean = np.trapezoid(grid * weight, grid) / np.trapezoid(weight, grid) if weight.sum() > 0.0 else 0.0
        assert pull == pytest.approx(mean, abs=1e-6)
    assert pull >= max(0.0, -margin)
    assert 0.0 <= cut <= 1.0


def test_an_estimate_that_does_not_count_leaves_a_reason():
    trend = Trend.start(0.0, SETTINGS).update(seen(0.0, 0.2, 0.01))
    for status in (GapStatus.UNIDENTIFIABLE, GapStatus.MODEL_MISMATCH):
        after = trend.update(replace(seen(10.0, math.nan, math.inf, status)))
        np.testing.assert_array_equal(after.mean, trend.predict(10.0).mean)
        assert status.value in after.reasons[0]
        assert "because" in after.reasons[0]


STEADY = replace(SETTINGS, outlier_std=6.0, rate_walk_rad_per_s_per_sqrt_s=1e-6)


def steady() -> Trend:
    """At 0.3 rad for 30 s."""
    trend = Trend.start(0.0, STEADY)
    for k in range(4):
        trend = trend.update(seen(10.0 * k, 0.3, 0.001))
    return trend


def test_an_outlier_moves_nothing_and_says_why():
    once = steady().update(seen(40.0, 0.8, 0.001))
    np.testing.assert_array_equal(once.mean, steady().predict(40.0).mean)
    assert (once.refused, once.updates) == (1, 4)
    assert "outlier" in once.reasons[0]
    after = once.update(seen(50.0, 0.3, 0.001))
    assert (after.refused, after.rival, after.reasons) == (0, None, ())


def test_outliers_that_agree_are_a_change_of_the_machine():
    """The second of them already counts; the pace of wear and its spread stay."""
    repaired = steady().update(seen(40.0, 0.02, 0.001)).update(seen(50.0, 0.021, 0.001))
    assert repaired.gap == pytest.approx(0.0205, abs=1e-3)
    assert (repaired.refused, repaired.updates, repaired.rival) == (0, 6, None)
    assert "repair" in repaired.reasons[0]
    assert repaired.rate_std < 2.0 * steady().rate_std
    assert repaired.update(seen(60.0, 0.02, 0.001)).reasons == ()


def test_outliers_that_disagree_stay_outliers():
    """Each is measured against the one before it, at any rate that was plausible at the start; a window that was
    expected ends it all."""
    trend = replace(steady(), settings=replace(STEADY, rate_std_rad_per_s=2e-3))
    for k, gap in enumerate((0.8, 0.1, 0.6, 0.05)):
        trend = trend.update(seen(40.0 + 10.0 * k, gap, 0.001))
        assert trend.refused == k + 1
        assert trend.gap == pytest.approx(0.3, abs=0.01)
    assert trend.update(seen(80.0, 0.3, 0.001)).refused == 0
    assert trend.update(seen(80.0, 0.05, 0.001)).gap == pytest.approx(0.05, abs=0.005)


@pytest.mark.parametrize("every", [20.0, 200.0])
def test_a_wear_rate_that_no_longer_holds_costs_three_windows(every):
    """Otherwise 283 windows of 20 s, or 29 of 200 s, did not count: a rival with the learnt rate is as wrong."""
    trend, time, gap = Trend.start(0.0, TrendSettings.for_wear(math.radians(10.0), 3600.0)), 0.0, 4.0
    for k in range(43):
        step, rate = (20.0, 48.0) if k < 40 else (every, 4.0)
        time, gap = time + step, gap + rate * step / 3600.0
        trend = trend.update(seen(time, math.radians(gap), math.radians(0.02)))
    assert trend.refused == 0
    assert math.degrees(trend.gap) == pytest.approx(gap, abs=0.05)
    assert 3600.0 * math.degrees(trend.rate) == pytest.approx(4.0, abs=2.0)


def test_how_many_must_agree_is_a_setting():
    one, three = (replace(steady(), settings=replace(STEADY, restart_after=n)) for n in (1, 3))
    assert one.update(seen(40.0, 0.8, 0.001)).gap == pytest.approx(0.8, abs=1e-3)
    for k in range(3):
        assert three.refused == k
        three = three.update(seen(40.0 + 10.0 * k, 0.8, 0.001))
    assert three.gap == pytest.approx(0.8, abs=1e-3)
    assert three.refused == 0


def test_a_gap_read_by_the_carried_offset_is_one_equation():
    """Measuring gap - 2 offset equals least squares with that row; a hundred such windows add no more information."""
    known = Trend.start(0.0, SETTINGS).update(seen(0.0, 0.3, 0.02), OffsetReading(0.1, 0.01))
    std = math.hypot(2.0 * known.prior.offset_std, 1e-3)
    lean = CarriedOffset(known.prior.offset, known.prior.offset_std, 2.0)
    after = known.update(seen(0.0, 0.31, std), lean)
    row, before = np.array([[1.0, 0.0, -2.0]]), np.linalg.inv(known.covariance)
    covariance = np.linalg.inv(before + row.T @ row / 1e-6)
    right = before @ known.mean + row[0] * (0.31 - 2.0 * known.prior.offset) / 1e-6
    np.testing.assert_allclose(after.mean, covariance @ right, rtol=1e-7)
    for _ in range(100):
        after = after.update(seen(0.0, 0.31, std), lean)
    free = np.linalg.inv(np.linalg.inv(known.covariance[np.ix_([0, 2], [0, 2])]) + np.outer([1, -2], [1, -2]) * 1e12)
    assert after.covariance[0, 0] == pytest.approx(free[0, 0], rel=1e-3)


def test_an_outlier_that_rests_on_the_carried_offset_starts_no_new_trend():
    trend = steady().update(seen(40.0, 0.3, 0.001), OffsetReading(0.0, 0.001))
    lean = CarriedOffset(0.0, 0.001, 2.0)
    trend = trend.update(seen(50.0, 0.8, 0.003), lean)
    assert (trend.refused, trend.rival) == (1, None)
    assert trend.prior.gap == pytest.approx(0.3, abs=0.01)
    assert trend.prior.offset_std == STEADY.offset_std_rad
    assert "forgotten" in trend.reasons[1]


def test_a_moved_encoder_costs_no_window():
    trend = steady().update(seen(40.0, 0.3, 0.001), OffsetReading(0.0, 0.001))
    moved = trend.update(seen(50.0, 0.3, 0.001), OffsetReading(0.2, 0.001))
    assert (moved.refused, moved.updates) == (0, 6)
    assert moved.prior.offset == pytest.approx(0.2, abs=1e-3)
    assert "read anew" in moved.reasons[0]


def test_a_prior_for_the_next_window():
    trend = Trend.start(0.0, SETTINGS)
    for k in range(5):
        trend = trend.update(seen(10.0 * k, 0.1 + 0.01 * k, 1e-3), OffsetReading(0.05, 1e-3))
    prior = trend.predict(50.0).prior
    assert prior.gap == pytest.approx(0.15, abs=3e-3)
    assert prior.gap_std > trend.gap_std
    assert prior.offset == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: TrendSettings(gap_std_rad=-1.0),
        lambda: TrendSettings(outlier_std=math.nan),
        lambda: TrendSettings(restart_after=0),
        lambda: TrendSettings.for_wear(0.0, 1.0),
        lambda: Trend.start(math.inf, TrendSettings()),
        lambda: Trend.start(1.0, TrendSettings()).predict(0.0),
        lambda: Trend.start(0.0, TrendSettings()).time_until(-1.0),
        lambda: Trend.start(0.0, TrendSettings()).update(seen(0.0, 0.1, 0.01), OffsetReading(0.0, 0.01, 1.0)),
    ],
)
def test_nonsense_is_refused(wrong):
    with pytest.raises(InvalidInput):
        wrong()


@pytest.mark.parametrize("share", [0.01, 0.15])
def test_a_first_gap_of_several_turns_of_the_motor_counts(share: float) -> None:
    """The prior's 60 degrees are nobody's statement: a gap behind a gear of a hundred turns is no outlier."""
    gap = 826.0 * DEG
    found = Trend.start(0.0, TrendSettings()).update(seen(1.0, gap, share * gap))
    assert (found.updates, found.refused) == (1, 0)
    assert found.gap == pytest.approx(gap, rel=0.03)
    assert found.gap_interval[0] < gap < found.gap_interval[1]


def test_a_jump_to_several_turns_of_the_motor_starts_the_trend_afresh_there() -> None:
    gap = 826.0 * DEG
    found = Trend.start(0.0, TrendSettings()).update(seen(1.0, 10.0 * DEG, 0.1 * DEG))
    for time in (2.0, 3.0):
        found = found.update(seen(time, gap, 0.15 * gap))
    assert found.afresh
    assert found.gap == pytest.approx(gap, rel=0.03)


def test_a_gap_that_closed_is_not_followed_below_zero() -> None:
    """A new screw within the spread of a rate that is not known yet: the next windows were outliers."""
    settings = TrendSettings(rate_std_rad_per_s=0.2 * DEG)
    trend = Trend.start(0.0, settings)
    for time, gap in ((0.0, 3.0), (20.0, 3.0), (40.0, 0.02)):
        trend = trend.update(seen(time, gap * DEG, 0.05 * DEG))
    assert trend.refused == 0
    assert trend.rate < 0.0
    later = trend.predict(60.0)
    assert later.mean[0] == later.mean[1] == 0.0
    assert later.predict(80.0).covariance == pytest.approx(trend.predict(80.0).covariance)
    trend = trend.update(seen(60.0, 0.02 * DEG, 0.05 * DEG))
    assert trend.refused == 0
    assert trend.gap == pytest.approx(0.02 * DEG, abs=0.05 * DEG)
