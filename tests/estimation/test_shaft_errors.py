"""Jitter of the samples' times and slow motion that the model of a free shaft leaves: wider intervals, no lessons."""

import math
from functools import cache

import numpy as np
import pytest

from benchmarks.axis_faults import faulty_windows
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.output_error import OutputErrorSettings, fit
from servotwin.estimation.output_error.jitter import _DEPENDENT, _GAIN, _regressed, time_jitter
from servotwin.estimation.output_error.learnt_shaft import shaft_reading
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis

SCREW = Axis.preset("ball-screw")
KNOWN = FactorPrior(np.zeros(4), np.diag(np.square([0.08, 0.5, 0.005, 0.05])))


@cache
def screw(kind: str = "none", seed: int = 5) -> tuple[float, Window]:
    """Total gap (rad) and a window of a ball screw with a kind of fault."""
    _, gap, window = next(faulty_windows("ball-screw", kind, 1, seed))
    return gap, window


@pytest.mark.slow
def test_jitter_of_the_times_is_measured_and_widens_the_interval_or_is_refused() -> None:
    for kind, samples in (("position jitters by 0.1", 0.1), ("position jitters by 0.3", 0.3)):
        gap, window = screw(kind)
        jitter = time_jitter(fit(window, SCREW, None, OutputErrorSettings()))
        assert jitter.time * window.sample_rate == pytest.approx(samples, rel=0.5)
        assert not jitter.lasting
        estimate = estimate_gap(window, SCREW)
        low, high = estimate.interval
        assert not estimate.ok or low <= gap <= high
        assert not estimate.ok or high - low >= 4.0 * (2.0 / SCREW.p) * jitter.half


@pytest.mark.slow
def test_a_window_without_jitter_shows_none() -> None:
    gap, window = screw()
    jitter = time_jitter(fit(window, SCREW, None, OutputErrorSettings()))
    assert (jitter.time, jitter.half) == (0.0, 0.0)
    estimate = estimate_gap(window, SCREW)
    assert estimate.ok
    assert abs(estimate.gap - gap) < 0.01 * gap


def test_the_statistic_of_jitter_has_the_stated_distribution_in_white_noise() -> None:
    """Chi-square with one degree of freedom, of which the half is seen that grows with the speed."""
    rng, speed = np.random.default_rng(2), np.sin(np.arange(3000) / 200.0) ** 3
    tests = []
    for noise in rng.normal(size=(2000, speed.size)):
        squares = (noise[1:-1] - 0.5 * (noise[2:] + noise[:-2])) ** 2 / _GAIN
        tests.append(_regressed(squares, speed[1:-1] ** 2)[0] / _DEPENDENT)
    assert np.mean(np.greater(tests, 0.0)) == pytest.approx(0.5, abs=0.05)
    for quantile, value in ((0.90, 1.642), (0.95, 2.706), (0.99, 5.412)):  # of chi-square at 0.8, 0.9, 0.98
        assert np.mean(np.greater(tests, value)) == pytest.approx(1.0 - quantile, rel=0.35)


@pytest.mark.slow
@pytest.mark.parametrize("step", [1e-9, 1e-7, 1e-5])
def test_friction_leaves_the_motion_smooth_in_every_number(step: float) -> None:
    """A load that was held, or was not, by rounding made jumps of a thousandth of the gap: derivatives were up to a
    hundred times too large, and gaps better known than they were."""
    gap, window = screw()
    found = fit(erring(window, gap, 0.25), SCREW, None, OutputErrorSettings(), KNOWN)
    problem, best = found.problem, found.best
    usual, here = problem.sizes(), problem.misfit(best.values)
    for i in np.flatnonzero(found.free)[:-2]:  # all but the motion before the window
        slopes = []
        for side in (-step, step, 1e-4):
            moved = best.values.copy()
            moved[i] += side * usual[i]
            slopes.append(float(np.linalg.norm(problem.misfit(moved) - here)) / abs(side))
        assert slopes == pytest.approx([slopes[-1]] * 3, rel=0.3), problem.model.unknowns[i].name


def erring(window: Window, gap: float, share: float) -> Window:
    """The window with a position sensor that errs by a share of the gap (peak to peak) with its way."""
    at_load = gap * SCREW.p
    wave = 0.5 * share * at_load * np.sin(2.0 * math.pi * window.position / (40.0 * at_load) + 1.0)
    return window.replace(position=window.position + wave)


@pytest.mark.slow
def test_a_sensor_that_errs_with_its_way_is_not_named_as_jitter() -> None:
    """Its quick errors grow with the speed too, but they last; a jitter of 3 us was named."""
    gap, window = screw(seed=6)
    wrong = erring(window, gap, 0.5)
    found = time_jitter(fit(wrong, SCREW, None, OutputErrorSettings()))
    assert found.time > 0.0, "the errors do not grow with the speed: another window is needed"
    assert found.lasting
    assert not any("jitter" in reason for reason in estimate_gap(wrong, SCREW).reasons)
    shaken = estimate_gap(screw("position jitters by 0.3")[1], SCREW)
    assert any("as where the times of the samples jitter by" in reason for reason in shaken.reasons), shaken.reasons


@pytest.mark.slow
def test_a_window_with_slow_motion_that_the_model_leaves_teaches_less_or_nothing() -> None:
    gap, window = screw()
    spreads = []
    for share in (0.0, 0.25, 0.5):
        found = fit(erring(window, gap, share), SCREW, None, OutputErrorSettings(), KNOWN)
        reading = shaft_reading(found, KNOWN, 1.1).machine
        spreads.append(math.sqrt(np.reshape(reading.covariance, (4, 4))[0, 0]))
    known = math.sqrt(KNOWN.covariance[0, 0])
    assert spreads[0] < 0.2 * known
    assert spreads[1] > 0.9 * known
    assert spreads[2] > 0.99 * known
