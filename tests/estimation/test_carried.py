"""The encoder's offset carried from window to window: one contact becomes enough, and only within a boot."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.estimation import whitened
from servotwin.estimation.estimate import CarriedOffset, GapEstimate, GapStatus, OffsetReading
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.learning.trend import Trend, TrendSettings
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.whitened import estimate_carrying, offset
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate
from servotwin.twin.estimating import decode_window
from servotwin.twin.model import TwinModel
from servotwin.twin.twin import Twin

DEG = math.radians(1.0)
SETTINGS = whitened.WhitenedSettings()
SERVO = Servo.preset("paper").replace(Ki=0.0)
GAP = 12.0 * DEG
REFUSED = {GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND}


@cache
def loop() -> Loop:
    """A calm loop whose windows, once the gap has grown, end before the screw is pushed the other way."""
    scenario = Scenario.preset("calm")
    return cosimulate(scenario.replace(recording=replace(scenario.recording, window=1.0, pre_trigger=0.0)))


def truth(estimate: GapEstimate) -> float:
    return float(loop().scenario.gap.pieces(loop().scenario.duration).value(estimate.time))


def holds(estimate: GapEstimate, gap: float) -> bool:
    return estimate.interval[0] <= gap <= estimate.interval[1]


def one_sided() -> list[int]:
    return [k for k, e in enumerate(loop().estimates) if isinstance(e.offset, CarriedOffset)]


@pytest.mark.slow
def test_one_contact_is_enough_after_a_window_with_two():
    assert len(one_sided()) >= 5
    for k in one_sided():
        estimate = loop().estimates[k]
        assert estimate.ok
        assert holds(estimate, truth(estimate))
        assert estimate.gap == pytest.approx(truth(estimate), abs=0.005 * DEG)
    alone = [estimate_gap(decode_window(loop().windows[k]), loop().scenario.servo) for k in one_sided()]
    assert sum(e.status in REFUSED for e in alone) >= len(alone) - 1
    assert {type(e.offset) for e in loop().estimates[:3]} == {OffsetReading}


def replay(changed_boot: bool) -> GapEstimate:
    """What the twin says of the first window that can hardly stand alone, in the boot of those before it or another."""
    scenario = loop().scenario
    twin = Twin(scenario.name, TwinModel.of(scenario.servo, scenario.twin))
    last = one_sided()[1]
    for message in loop().windows[: last + 1]:
        new = changed_boot and message is loop().windows[last]
        twin.receive(msgspec.structs.replace(message, boot="new") if new else message, message.start + 2.0)
    return list(twin.log.estimates.values())[-1]


@pytest.mark.slow
def test_a_new_boot_forgets_the_offset():
    kept, forgotten = replay(False), replay(True)
    assert kept.ok
    assert holds(kept, truth(kept))
    assert forgotten.status in REFUSED
    assert "needed both ways" in forgotten.reasons[0]


@cache
def stretch(start: float, duration: float) -> Window:
    run = simulate(SERVO, 12.0, reference=SquareWave(1e-3, 10.0), gap=GAP)
    return Window.from_run(run, start, duration)


def noisy(window: Window, seed: int, shift: float = 0.0) -> Window:
    noise = 1e-6 * np.random.default_rng(seed).standard_normal(window.position.size)
    return window.replace(position=window.position + noise, theta_m=window.theta_m + shift)


def carried(trend: Trend) -> tuple[float, float]:
    return trend.prior.offset, trend.prior.offset_std


@pytest.mark.slow
def test_spreads_and_the_trend_hold_what_they_say():
    """An encoder that is 40 deg off, 1 um of noise: the trend's gap and offset after one window of each kind."""
    settings = whitened.WhitenedSettings(model_error=0.0, largest_std=DEG)
    scores = []
    for seed in range(14):
        both = noisy(stretch(5.0, 2.0), seed, 40.0 * DEG)
        first = estimate_carrying(both, SERVO, None, settings, None)
        trend = Trend.start(0.0, TrendSettings(shared_error_rad=0.0)).update(first)
        one = noisy(stretch(5.0, 1.2), 100 + seed, 40.0 * DEG)
        second = estimate_carrying(one, SERVO, trend.as_estimate(), settings, carried(trend))
        assert isinstance(second.offset, CarriedOffset)
        after = trend.update(replace(second, time=first.time))
        assert after.gap_std <= trend.gap_std
        offset = (trend.mean[2] + 40.0 * DEG) / trend.prior.offset_std
        scores.append([offset, (second.gap - GAP) / second.std_total, (after.gap - GAP) / after.gap_std])
    assert np.all(np.mean(np.abs(scores) < 1.96, axis=0) >= 0.85)


def test_a_window_with_two_contacts_never_uses_the_carried_offset():
    window = noisy(stretch(5.0, 2.0), 1)
    alone = estimate_gap(window, SERVO)
    with_offset = estimate_carrying(window, SERVO, None, SETTINGS, (3.0, 1e-6))
    assert replace(with_offset, offset=None) == alone
    assert with_offset.offset.offset == pytest.approx(0.0, abs=0.02 * DEG)


def test_a_fit_that_the_carried_offset_spoils_is_not_used(monkeypatch):
    """However sure it is: an offset that is right does not change what is left over."""
    window, true = noisy(stretch(5.0, 1.2), 1), whitened.fit

    def lost(window, servo, prior, settings, machine, first=None):
        fitted = true(window, servo, prior, settings, machine, first)
        right = fitted.concluded()
        wrong = replace(right, gap=right.gap + DEG, rms=100.0 * right.rms)
        return fitted if settings.offset is None else SimpleNamespace(servo=servo, concluded=lambda: wrong)

    known = (0.0, 0.01 * DEG)
    assert estimate_carrying(window, SERVO, None, SETTINGS, known).ok
    monkeypatch.setattr(offset, "fit", lost)
    refused = estimate_carrying(window, SERVO, None, SETTINGS, known)
    assert refused.status in REFUSED
    assert "times the residual is left" in refused.reasons[-1]


def test_an_offset_that_is_too_uncertain_is_not_carried():
    window = noisy(stretch(5.0, 1.2), 1)
    for known in (None, (0.0, 0.1 * DEG)):
        assert estimate_carrying(window, SERVO, None, SETTINGS, known).status in REFUSED


def test_an_encoder_that_slipped_is_read_anew_or_doubted():
    """A window with two contacts counts all the same. With the old offset, one contact would show a gap that is 6 deg
    off: that is no estimate, and ends the offset's use."""
    settings = TrendSettings.for_wear(GAP, 1e5)
    trend, wear = Trend.start(0.0, settings), Wear(0.0)
    for k in range(3):
        window = noisy(stretch(5.0, 2.0), k)
        estimate = replace(estimate_carrying(window, SERVO, None, SETTINGS, None), time=20.0 * k)
        trend, wear = trend.update(estimate), wear.update(settings, "boot", estimate, 20.0 * k)[0]
    slip = -3.0 * DEG
    both = estimate_carrying(noisy(stretch(5.0, 2.0), 5, slip), SERVO, None, SETTINGS, carried(trend))
    moved = trend.update(replace(both, time=60.0))
    assert (moved.refused, moved.updates) == (0, 4)
    assert "read anew" in moved.reasons[0]
    assert moved.prior.offset == pytest.approx(-slip, abs=0.02 * DEG)
    window = noisy(stretch(5.0, 1.2), 6, slip)
    with_offset = estimate_carrying(window, SERVO, trend.as_estimate(), SETTINGS, carried(trend))
    assert with_offset.status in REFUSED
    assert "the gap would be 18 deg, and 12 deg are expected" in with_offset.reasons[-1]
    assert wear.expect(settings, "boot", 60.0, 60.0).offset is not None
    doubted, _ = wear.update(settings, "boot", replace(with_offset, time=60.0), 60.0)
    assert doubted.expect(settings, "boot", 80.0, 80.0).offset is None
    assert doubted.trend(settings).gap == pytest.approx(GAP, abs=0.1 * DEG)
    right = estimate_carrying(noisy(stretch(5.0, 1.2), 6), SERVO, trend.as_estimate(), SETTINGS, carried(trend))
    assert right.ok


def test_a_gap_that_the_trend_refuses_ends_the_use_of_its_offset():
    trend = Trend.start(0.0, TrendSettings.for_wear(GAP, 1e5))
    first = GapEstimate(GAP, 1e-4, 1e-4, (GAP - 2e-4, GAP + 2e-4), GapStatus.OK, 0.0)
    trend = trend.update(first, OffsetReading(0.0, 1e-4, 0.0))
    wide = replace(first, gap=1.5 * GAP, time=20.0)
    doubted = trend.update(wide, CarriedOffset(0.0, 1e-4, 2.0))
    assert doubted.refused == 1
    assert doubted.gap == pytest.approx(GAP, abs=0.1 * DEG)
    assert "forgotten" in doubted.reasons[1]
    assert doubted.prior.offset_std == doubted.settings.offset_std_rad


@pytest.mark.slow
def test_a_loop_reports_bias_and_reason_for_every_window():
    assert len(loop().disturbances) == len(loop().redesigns) == len(loop().estimates) == 10
    for estimate, redesign in zip(loop().estimates, loop().redesigns, strict=True):
        assert (redesign.setting is not None) == estimate.ok == (redesign.reason == "")
    assert {len(d.reasons) for d in loop().disturbances if not d.known} <= {1}


def test_the_machine_s_numbers_are_fitted_once_where_one_contact_needs_the_carried_offset(monkeypatch):
    """A fit of the gap alone decides whether the offset is needed; a window of two contacts is fitted as without an
    offset, bit for bit."""
    fits = []
    monkeypatch.setattr(offset, "fit", lambda *given: fits.append(given) or whitened.fit(*given))
    machine, known = FactorPrior.of_spreads(1e-3, 5e-3, 1e-5, 2e-3), (0.0, 0.01 * DEG)
    assert not machine.wide
    one = estimate_carrying(noisy(stretch(5.0, 1.2), 1), SERVO, None, SETTINGS, known, machine)
    assert one.ok
    assert len(fits) == 1
    both = noisy(stretch(5.0, 2.0), 1)
    assert estimate_carrying(both, SERVO, None, SETTINGS, known, machine) == estimate_carrying(
        both, SERVO, None, SETTINGS, None, machine
    )
