"""Gaps between encoders of few counts: errors of rounding, noise of the motor's encoder, lags and delays."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from scipy.signal import lfilter

from servotwin.estimation.core.motor_angle import without_counts, without_noise
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.output_error import OutputErrorSettings
from servotwin.estimation.output_error.estimator import _problem, fit, fitted
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.mismatches import hidden
from servotwin.estimation.output_error.play_model import lagged
from servotwin.estimation.output_error.possible import possible_half
from servotwin.estimation.output_error.search import search
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.noise import Noise
from servotwin.plant.signals import Array, SquareWave
from servotwin.simulation import simulate


@pytest.mark.slow
@pytest.mark.parametrize("far", [55.2e-6, 70e-6])
def test_a_motor_that_creeps_through_its_gap_repeats_one_error_of_rounding(far: float) -> None:
    """The load rests at one count meanwhile: taken for many small errors these said 3.03 +- 0.05 deg for 3.6."""
    axis, gap, time = Axis.preset("stepper-stage"), math.radians(3.6), np.arange(6000) / 1000.0
    creep = 2e-6 * (np.clip(time - 1.0, 0.0, 1.5) - np.clip(time - 4.5, 0.0, 1.0))
    there = far * (2.0 * np.exp(-6.0 * time) - 1.0)
    back = there[2499] + 2.0 * far * (1.0 - np.exp(-6.0 * (time - 2.5)))
    angle = (np.where(time < 2.5, there, back) + creep) / axis.p
    position = axis.p * play(angle, gap, angle[0] - 0.5 * gap)
    steps = axis.sensors.position_resolution, axis.sensors.encoder_resolution
    seen = [step * np.round(values / step) for values, step in zip((position, angle), steps, strict=True)]
    estimate = estimate_gap(Window(*seen, sample_rate=1000.0), axis)
    assert estimate.interval[0] <= gap <= estimate.interval[1]
    assert not estimate.ok or abs(estimate.gap / gap - 1.0) < 0.02


def _creep(far: float, time: Array, random: np.random.Generator) -> Array:
    ends, rate, part = far * (-1.0) ** np.arange(4), random.uniform(2.0, 8.0), time[: time.size // 4]
    return np.concatenate([b + (a - b) * np.exp(-rate * part) for a, b in zip(-ends, ends, strict=True)])


def _sine(far: float, time: Array, random: np.random.Generator) -> Array:
    return far * np.sin(2.0 * math.pi * random.uniform(0.3, 2.0) * time + random.uniform(0.0, 6.0))


def _moves(far: float, time: Array, random: np.random.Generator) -> Array:
    ends = far * random.uniform(0.5, 1.0, 5) * (-1.0) ** np.arange(5)
    done = np.clip(time[: time.size // 4] / random.uniform(0.1, 0.6), 0.0, 1.0)
    return np.concatenate([a + (b - a) * done**2 * (3.0 - 2.0 * done) for a, b in pairwise(ends)])


_CREPT = (102, 107, 110, 113, 116, 121)
"""Seeds of windows: least squares alone leaves the gap of a creeping motor wrong in one of them, unknown in four."""


class _Counted(NamedTuple):
    window: Window
    gap: float


def _counted(
    motion: Callable[[float, Array, np.random.Generator], Array],
    seed: int | list[int],
    noise: float = 0.0,
    off: bool = False,
    lag: float = 0.0,
) -> _Counted:
    """A stage of steps under a motion; noise of the encoders in counts, ratio and delay that are off or not, and a lag
    (s) of the position."""
    axis, random = Axis.preset("stepper-stage"), np.random.default_rng(seed)
    gap = math.radians(random.uniform(2.0, 8.0))
    angle = motion(gap + math.radians(random.uniform(2.0, 20.0)), np.arange(6000) / 1000.0, random)
    position = axis.p * play(angle, gap, angle[0] + random.uniform(-0.5, 0.5) * gap)
    if off:
        ratio, delay, at = 1.0 + 0.004 * random.normal(), 1.5 * random.normal(), np.arange(angle.size)
        position = ratio * np.interp(at - delay, at, position)
    if lag:
        decay = math.exp(-1e-3 / lag)
        share = (1.0 - decay) * lag / 1e-3
        position = position[0] + lfilter([1.0 - share, share - decay], [1.0, -decay], position - position[0])
    steps = axis.sensors.position_resolution, axis.sensors.encoder_resolution
    seen = [
        step * np.round(values / step + noise * random.normal(size=values.size))
        for values, step in zip((position, angle), steps, strict=True)
    ]
    return _Counted(Window(*seen, sample_rate=1000.0), gap)


@pytest.mark.slow
@pytest.mark.parametrize(("motion", "seeds"), [(_creep, _CREPT), (_sine, _CREPT[:2]), (_moves, _CREPT[:2])])
def test_errors_of_rounding_that_depend_on_each_other_are_no_reason_for_a_wrong_gap(
    motion: Callable[..., Array], seeds: tuple[int, ...]
) -> None:
    """Least squares bends ratio and delay to fit them: 8 of 19 accepted windows that crept were false.

    Those of the other motions were not; they must stay accepted.
    """
    accepted = 0
    for seed in seeds:
        window, gap = _counted(motion, seed)
        estimate = estimate_gap(window, Axis.preset("stepper-stage"))
        accepted += estimate.ok
        assert not estimate.ok or estimate.interval[0] <= gap <= estimate.interval[1], seed
        assert not estimate.ok or abs(estimate.gap / gap - 1.0) < 0.02, seed
    assert accepted >= len(seeds) * 2 / 3


def test_a_lag_of_straight_lines_is_exact() -> None:
    time, samples = np.arange(60.0), 4.3
    kinked = np.where(time < 20.0, time, 20.0)
    ramp = time - samples * (1.0 - np.exp(-time / samples))
    after = 20.0 + (ramp[20] - 20.0) * np.exp(-(time - 20.0) / samples)
    assert lagged(kinked, samples) == pytest.approx(np.where(time < 20.0, ramp, after), abs=1e-12)
    assert np.array_equal(lagged(kinked, 0.0), kinked)


@pytest.mark.slow
@pytest.mark.parametrize(("motion", "seed"), [(_sine, [9012, 1]), (_moves, [9011, 2])])
def test_a_lag_between_the_encoders_is_not_taken_for_gap(motion: Callable[..., Array], seed: list[int]) -> None:
    """Not fitted, a lag of 5 ms left these gaps 4.1 +- 1.1 % and 2.9 +- 0.9 % off."""
    window, gap = _counted(motion, seed, off=True, lag=5e-3)
    estimate = estimate_gap(window, Axis.preset("stepper-stage"))
    assert estimate.ok, estimate.reasons
    assert estimate.interval[0] <= gap <= estimate.interval[1]


def test_a_lag_beyond_what_is_known_is_a_mismatch() -> None:
    window, _ = _counted(_sine, [9010, 1], off=True, lag=20e-3)
    estimate = estimate_gap(window, Axis.preset("stepper-stage"))
    assert estimate.status is GapStatus.MODEL_MISMATCH
    assert "the lag would be off by" in " ".join(estimate.reasons)


def test_a_motor_that_creeps_is_fitted_at_every_delay() -> None:
    """Gaps that need another delay lay behind a wall: 6.7 +- 0.2 deg for 6.38."""
    window, gap = _counted(_creep, [9013, 0], off=True)
    estimate = estimate_gap(window, Axis.preset("stepper-stage"))
    assert estimate.interval[0] <= gap <= estimate.interval[1]


@pytest.mark.parametrize(("seed", "noise"), [(430, 0.0), (638, 0.0), (610, 0.4)])
def test_errors_of_rounding_that_creep_repeats_count_as_few(seed: int, noise: float) -> None:
    """Taken for thousands of errors within a bound they left gaps 14, 20 and 6 % off, with narrow intervals."""
    window, gap = _counted(_creep, seed, noise, off=True)
    estimate = estimate_gap(window, Axis.preset("stepper-stage"))
    assert estimate.interval[0] <= gap <= estimate.interval[1]


def test_the_gaps_that_rounding_leaves_possible() -> None:
    axis = Axis.preset("stepper-stage")
    window, gap = _counted(_creep, 110)
    assert window.theta_m is not None
    found = search(_problem(window, window.theta_m, axis, OutputErrorSettings()), 0.0)
    half, possible = 0.5 * axis.p * gap, possible_half(found)
    assert possible is not None
    # The best fit is many of its own standard deviations off.
    assert abs(found.best.values[0] - half) > 10.0 * found.best.std(0, found.free)
    assert abs(possible.mean - half) < 2.0 * possible.std < 0.1 * half


def _angle(window: Window) -> Array:
    assert window.theta_m is not None
    return window.theta_m


@pytest.mark.slow
@pytest.mark.parametrize("seed", [286, 288, 293, 304])
def test_a_motor_that_creeps_in_noise_tells_its_gap_no_better_than_ratio_and_delay_are_known(seed: int) -> None:
    """One rate of creeping makes the same motion with another gap, ratio and delay: three of these were 2 to 4 % off,
    by 2 to 4 standard deviations."""
    window, gap = _counted(_creep, seed, noise=2.0, off=True)
    estimate = estimate_gap(window, Axis.preset("stepper-stage"))
    assert estimate.ok, estimate.reasons
    assert estimate.interval[0] <= gap <= estimate.interval[1]


@pytest.mark.slow
def test_the_best_fit_in_noise_is_one_of_many_gaps() -> None:
    axis = Axis.preset("stepper-stage")
    window, gap = _counted(_creep, 304, noise=2.0, off=True)
    angle = without_noise(_angle(window), axis.encoder_resolution).angle
    found = search(_problem(window, angle, axis, OutputErrorSettings()), 0.0)
    half, possible = 0.5 * axis.p * gap, possible_half(found)
    assert possible is not None
    assert abs(possible.mean - half) < 2.0 * possible.std < 0.1 * half


def test_an_angle_without_its_noise_keeps_its_reversals() -> None:
    time, random = np.arange(4000) / 1000.0, np.random.default_rng(8)
    # Creeping to a place, and back at full speed.
    truth = np.where(time < 2.0, 1.0 - np.exp(-5.0 * time), np.exp(-5.0 * (time - 2.0)))
    noise = 2e-4 * random.normal(size=time.size)
    count = 1e-4
    seen = without_noise(count * np.round((truth + noise) / count), count)
    errors = seen.angle - truth
    assert np.std(errors) < 0.25 * np.std(noise)
    assert np.abs(errors[1990:2010]).max() < 3.5 * np.std(noise)
    assert 0.5 < seen.noise / np.std(errors) < 2.0
    quiet = count * np.round(truth / count)
    assert np.array_equal(without_noise(quiet, count).angle, quiet)


def test_an_angle_without_its_counts_stays_within_them() -> None:
    time, count = np.arange(4000) / 1000.0, 1e-4
    # Creeping to a place, and back at full speed: from 50 counts a sample to many samples a count.
    truth = np.where(time < 2.0, 1.0 - np.exp(-5.0 * time), np.exp(-5.0 * (time - 2.0)))
    shown = count * np.round(truth / count)
    errors = without_counts(shown, count) - truth
    assert np.std(errors) < 0.6 * np.std(shown - truth)
    assert np.abs(errors).max() <= count * (1.0 + 1e-9)
    assert np.array_equal(without_counts(truth, 0.0), truth)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 8])
def test_a_lag_that_averages_the_motor_s_rounding_is_not_taken_for_one(seed: int) -> None:
    """Noise of one count at the load, and steps of a loop in it: 1.8 +- 0.5 and 2.6 +- 1.0 deg were said of 1.04 and
    1.08."""
    axis, random = Axis.preset("stepper-stage"), np.random.default_rng([seed, 11])
    gap = math.radians(1.0 + 0.1 * random.random())
    run = simulate(
        axis, 8.5, reference=SquareWave(0.5e-3, 3.0), gap=gap, sample_rate=1000.0, noise=Noise(50e-9), seed=seed
    )
    made = fitted(Window.from_run(run, 3.0, 4.0), axis, None, OutputErrorSettings())
    assert made.search is not None
    assert made.search.best.values[0] == pytest.approx(0.5 * axis.p * gap, rel=0.1)
    assert not made.estimate.ok or made.estimate.interval[0] <= gap <= made.estimate.interval[1]


@pytest.mark.parametrize("seed", [5, 20])
def test_gaps_far_above_the_best_one_of_a_small_gap_are_weighed(seed: int) -> None:
    """In loud noise the best fits of 0.2 deg are at 0.01 and 0.03 deg, and gaps up to twice as wide alone were
    tried: 0.02 and 0.04 deg were said, within 0.08 deg."""
    axis, gap = Axis.preset("stepper-stage"), math.radians(0.2)
    run = simulate(
        axis.scaled({"p": 1.003}),
        10.0,
        reference=SquareWave(0.2e-3, 4.0),
        gap=gap,
        sample_rate=200.0,
        noise=Noise(200e-9, kind="white"),
        seed=seed,
    )
    estimate = estimate_gap(Window.from_run(run, 4.5, 4.0), axis)
    assert not estimate.ok or estimate.interval[0] <= gap <= estimate.interval[1]


def test_samples_where_the_motor_s_speed_jumps_do_not_count() -> None:
    axis = Axis.preset("stepper-stage")
    window, *_ = _counted(_creep, 110)
    unsure = _problem(window, _angle(window), axis, OutputErrorSettings()).unsure
    assert 0 < np.count_nonzero(unsure) < 0.05 * unsure.size
    assert np.flatnonzero(unsure).min() > 1400
    window, *_ = _counted(_sine, 110)
    assert not _problem(window, _angle(window), axis, OutputErrorSettings()).unsure.any()


@pytest.mark.slow
def test_noise_of_the_motor_that_pushes_the_load_widens_the_interval() -> None:
    """Play follows the extremes of the motor's noise: a gap of 0.5 to 8 deg seems up to 9 % wider."""
    inside = []
    for seed in (2, 3, 5):
        window, gap = _counted(_moves, seed, noise=2.0)
        estimate = estimate_gap(window, Axis.preset("stepper-stage"))
        assert estimate.ok, estimate.reasons
        inside.append(estimate.interval[0] <= gap <= estimate.interval[1])
    assert all(inside)


@pytest.mark.slow
def test_a_gap_that_jumps_within_a_window_of_large_moves_is_a_mismatch() -> None:
    """Its misfit was small beside the motion: 2.83 +- 0.24 deg for a gap of 4 deg that became 3 deg."""
    axis, random = Axis.preset("stepper-stage"), np.random.default_rng(7001)
    angle = _sine(math.radians(4.0 + random.uniform(2.0, 20.0)), np.arange(6000) / 1000.0, random)
    place = play(angle, math.radians(4.0), angle[0])
    place = np.concatenate([place[:3000], play(angle[3000:], math.radians(3.0), place[3000])])
    counts = axis.sensors.position_resolution, axis.sensors.encoder_resolution
    seen = [step * np.round(v / step) for v, step in zip((axis.p * place, angle), counts, strict=True)]
    estimate = estimate_gap(Window(*seen, sample_rate=1000.0), axis)
    assert estimate.status is GapStatus.MODEL_MISMATCH
    assert "of half the gap unexplained" in " ".join(estimate.reasons)


@pytest.mark.slow
@pytest.mark.parametrize(("stiffer", "fraction", "refused"), [(0.99, 1.0, False), (0.6, 0.001, True)])
def test_a_shaft_that_looks_soft_within_few_counts_is_no_mismatch(
    monkeypatch: pytest.MonkeyPatch, stiffer: float, fraction: float, refused: bool
) -> None:
    """A gap of a few counts of the motor's encoder; the same machine is refused where fine counts show a soft shaft."""
    axis, gap = Axis.preset("two-mass-drive"), 0.0182
    sensors = replace(axis.sensors, encoder_resolution=fraction * axis.encoder_resolution)
    axis = axis.replace(sensors=sensors)
    run = simulate(axis.scaled({"k": stiffer}), 15.0, reference=SquareWave(0.069, 20.0), gap=gap, sample_rate=2000.0)
    window = Window.from_run(run, 9.5, 5.0)
    searches = list[Search]()
    kept = f"{_problem.__module__}.search"
    monkeypatch.setattr(kept, lambda *given: searches.append(search(*given)) or searches[-1])
    estimate = estimate_gap(window, axis)
    found = searches[0]
    stiffness = next(place for place, each in enumerate(found.problem.model.unknowns) if each.name == "shaft stiffness")
    assert found.best.values[stiffness] < -0.2
    if refused:
        assert estimate.status is GapStatus.MODEL_MISMATCH
        assert estimate.reasons == ("the shaft stiffness would be off by -27 %",)
    else:
        assert estimate.ok
        assert estimate.interval[0] <= gap <= estimate.interval[1]


@pytest.mark.slow
@pytest.mark.parametrize(("fraction", "off"), [(1.0, False), (0.001, True)])
def test_counts_hide_a_stiffness_and_fine_ones_show_it(fraction: float, off: bool) -> None:
    """Seen on a two-mass drive with a gap of six counts, whose search ended at a stiffness that was 27 % too low."""
    axis = Axis.preset("two-mass-drive")
    axis = axis.replace(sensors=replace(axis.sensors, encoder_resolution=fraction * axis.encoder_resolution))
    machine = axis.scaled({"k": 0.7 if off else 0.97})
    run = simulate(machine, 15.0, reference=SquareWave(0.087, 20.0), gap=1.0 / 110.0, sample_rate=2000.0)
    found = fit(Window.from_run(run, 9.5, 5.0), axis, None, OutputErrorSettings())
    stiffness = next(place for place, each in enumerate(found.problem.model.unknowns) if each.name == "shaft stiffness")
    assert hidden(found, stiffness) is not off
