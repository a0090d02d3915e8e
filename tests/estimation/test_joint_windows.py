"""Several windows of one machine, the recorder's windows, what is left of a window, and the noise that a fit leaves."""

import math
from functools import lru_cache, partial

import numpy as np
import pytest
from exploration import explored

from benchmarks import estimator_joint as bench
from benchmarks.cramer_rao import bound, motor_unknowns, noise_root
from benchmarks.estimator_windows import RATE, WindowCase
from servotwin.errors import InvalidInput
from servotwin.estimation.core.whitening import Autoregression, burg
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.joint.estimator import JointSettings, SharedFit, estimate_jointly
from servotwin.estimation.joint.fit import likeliest, searched
from servotwin.estimation.joint.model import JointModel
from servotwin.estimation.window import Window
from servotwin.plant.backlash import play
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import Run, simulate

FLOOR = 1e-6  # m
SERVO = Servo.preset("paper")
DESCRIBED = bench.described(SERVO, bench.OFF)


@lru_cache
def run_of(gap_deg: float, stiffer: float = 1.0) -> Run:
    servo = SERVO.replace(k=stiffer * 1e4)
    return simulate(servo, 11.1, reference=SquareWave(1e-3, 10.0), gap=math.radians(gap_deg))


@lru_cache
def window_of(gap_deg: float, start: float = 5.0, stiffer: float = 1.0) -> Window:
    window = Window.from_run(run_of(gap_deg, stiffer), start, 1.0)
    noise = np.random.default_rng(round(10.0 * gap_deg + start)).standard_normal(window.position.size)
    return window.replace(position=window.position + FLOOR * noise)


@pytest.mark.slow
def test_windows_of_a_growing_gap_share_the_machine():
    """Each has its own gap, all have one machine: every spread is smaller than alone, every gap right."""
    gaps = (6.0, 10.0, 14.0)
    windows = [window_of(gap) for gap in gaps]
    together = estimate_jointly(windows, DESCRIBED)
    alone = [estimate_jointly(window, DESCRIBED) for window in windows]
    assert len(together.gaps) == 3
    assert together.gap == together.gaps[-1]
    for one, single, gap in zip(together.gaps, alone, gaps, strict=True):
        assert one.ok
        assert math.degrees(one.gap) == pytest.approx(gap, abs=0.02)
        assert one.std < single.gap.std
    assert together.parameters["k/m"].std < 0.8 * min(one.parameters["k/m"].std for one in alone)
    assert together.servo.p == pytest.approx(SERVO.p, rel=1e-4)


def test_one_window_is_a_sequence_of_one():
    one, same = (estimate_jointly(given, DESCRIBED) for given in (window_of(10.0), [window_of(10.0)]))
    assert one.gap == same.gap
    assert one.gaps == (one.gap,)


@pytest.mark.slow
@pytest.mark.parametrize("stiffer", [1.002, 1.02])
def test_windows_of_two_machines_contradict_each_other(stiffer):
    """The second machine's springs are 0.2 or 2 % stiffer; alone, each window is fine."""
    mixed = [window_of(10.0), window_of(10.0, stiffer=stiffer)]
    assert all(estimate_jointly(window, SERVO).gap.ok for window in mixed)
    found = estimate_jointly(mixed, SERVO)
    assert GapStatus.MODEL_MISMATCH in {one.status for one in found.gaps}
    reasons = " ".join(reason for one in found.gaps for reason in one.reasons)
    assert "the machine is not the same" in reasons


def test_a_useless_window_harms_no_other():
    good = window_of(10.0)
    still = Window(good.position, theta_m=np.full(good.position.size, 0.3), sample_rate=RATE)
    unrelated = good.replace(position=1e-3 * np.cumsum(np.random.default_rng(0).normal(size=good.position.size)))
    found = estimate_jointly([still, good, unrelated], DESCRIBED)
    assert [one.ok for one in found.gaps] == [False, True, False]
    assert found.gaps[1] == estimate_jointly(good, DESCRIBED).gap
    assert found.parameters["k/m"].factor == pytest.approx(1.0 / 1.05, abs=1e-3)


def test_windows_that_cannot_be_fitted_together_are_refused_with_the_reason():
    other = Window(np.zeros(2000), voltage=np.ones(2000), sample_rate=RATE)
    for windows, word in (((), "no window"), ((window_of(10.0), other), "alike")):
        with pytest.raises(InvalidInput, match=word):
            estimate_jointly(windows, SERVO)


def test_derivatives_of_the_whole_are_those_of_its_cost():
    names = ("gap", "place", "delay", "k/m", "pitch")
    models = [JointModel(window_of(gap), SERVO, names, None, 12) for gap in (6.0, 10.0)]
    whole = SharedFit.of([searched(model, None, JointSettings()) for model in models])
    assert [list(place) for place in whole.places] == [[2, 3, 4, 0, 1], [5, 6, 7, 0, 1]]
    point = whole._start([fit.best for fit in whole.fits])
    point[[0, 2, 5]] += 1e-4
    here = whole.evaluate(point)
    gradient = 2.0 * here.jacobian @ here.residual
    for index, step in enumerate((1e-7, 1e-7, 1e-7, 1e-4, 1e-9, 1e-7, 1e-4, 1e-9)):
        up, down = (whole.evaluate(point + sign * step * np.eye(8)[index]).cost for sign in (1.0, -1.0))
        slope = step * gradient[index]
        assert 0.5 * (up - down) == pytest.approx(slope, rel=2e-3, abs=1e-6 * here.cost), index


@pytest.mark.slow
@pytest.mark.parametrize("voltage", explored((False, True), 1))
def test_the_recorders_windows_meet_the_target(voltage):
    """2 s from 0.3 s before the step on, in `table1`, whose screw moves half as far: 0.03 and 0.02 deg."""
    loop = bench.recorded(bench.SAMPLED)
    groups = bench.windows(loop, "table1", 2, 5)
    found = bench.Errors.of(groups, [bench.estimates(group, loop, voltage, together=False) for group in groups])
    assert found.refused == 0
    assert found.largest < bench.LIMITS[voltage]
    assert found.coverage >= 0.75


@pytest.mark.slow
@pytest.mark.parametrize(("loop", "preset"), explored([(bench.CONTINUOUS, "paper"), (bench.SAMPLED, "table1")], 1))
def test_without_noise_the_voltages_jumps_cost_nothing(loop, preset):
    """The dead zone opens and the reference steps between samples; the stated spread covers what is left."""
    groups = bench.windows(loop, preset, 2, 11, floor=0.0)
    found = bench.Errors.of(groups, [bench.estimates(group, loop, voltage=True, together=False) for group in groups])
    assert found.refused == 0
    assert found.largest < 1e-3
    assert np.all(np.abs(found.errors) < 3.0 * found.stds)


def test_the_residual_is_the_noise():
    for window, noise in ((window_of(10.0), FLOOR), (Window.from_run(run_of(10.0), 5.0, 1.0), 0.0)):
        assert estimate_jointly(window, DESCRIBED).gap.rms == pytest.approx(noise, rel=0.05, abs=1e-9)


def test_a_lower_bound_is_one_number():
    """Where one way's travel is not enough: value and interval agree, and the bound is one."""
    window = window_of(10.0)
    plain = estimate_jointly(window, SERVO).gap
    travels = [float(part) for part in _travels(window, plain.gap, plain.theta_d0)]
    strict = JointSettings(contact_travel_rad=sum(travels) / 2.0)
    assert min(travels) < strict.contact_travel_rad < max(travels)
    found = estimate_jointly(window, SERVO, settings=strict).gap
    assert found.status is GapStatus.LOWER_BOUND
    assert found.interval == (found.gap, math.inf)
    assert math.isinf(found.std)
    assert math.isinf(found.std_total)
    assert math.radians(9.8) < found.gap < math.radians(10.0)


def _travels(window: Window, gap: float, theta_d0: float) -> tuple[float, float]:
    """rad: how far the screw is pushed forwards and backwards."""
    moved = np.diff(play(window.theta_m, gap, theta_d0))
    return moved[moved > 0.0].sum(), -moved[moved < 0.0].sum()


def test_the_noise_a_fit_leaves_is_not_taken_for_quieter_than_it_was():
    """White noise off which twelve slow columns were fitted: the plain criterion models the hole that this leaves."""
    rng, t = np.random.default_rng(4), np.linspace(-1.0, 1.0, 247)
    columns = np.vstack([np.cos(0.5 * math.pi * n * (t + 1.0)) for n in range(12)])
    plain, kept = [], []
    for _ in range(40):
        noise = rng.standard_normal(t.size)
        left = noise - np.linalg.lstsq(columns.T, noise, rcond=None)[0] @ columns
        plain.append(_gain(burg(left[None], 30)))
        kept.append(_gain(likeliest(left[None], np.vstack([noise, columns]), 30)))
    assert np.mean(np.log(plain)) < -0.5
    assert abs(np.mean(np.log(kept))) < 0.3


def _gain(noise: Autoregression) -> float:
    """Gain of slow noise, per sample."""
    return float(noise.spread[-1] / abs(noise.predictors[-1].sum()))


def cases_near_the_bound() -> list[list[WindowCase]]:
    """Two windows of each gap, in white noise."""
    return bench.windows(bench.CONTINUOUS, "paper", 2, 3)


@pytest.mark.slow
def test_the_bound_grows_with_what_is_unknown():
    case, root = cases_near_the_bound()[0][0], noise_root(5000, RATE, FLOOR, None)
    bound_in = partial(bound, SERVO, case.window.theta_m, RATE, case.gap, case.theta_d0)
    plain, structure = bound_in(root), bound_in(root, free=("k", "c", "p"))
    motor = bound_in(root, angles=motor_unknowns(SERVO, case.window.voltage, RATE, zero_order_hold=False))
    assert plain < structure < 5.0 * plain
    assert plain < motor < 2.0 * plain
    assert bound_in(2.0 * root, free=("k", "c", "p")) == pytest.approx(2.0 * structure, rel=1e-6)


@pytest.mark.slow
@pytest.mark.exploration
def test_the_errors_are_near_the_bound():
    """By code of its own; an estimator below it would have known the answer, one far above it wastes data."""
    groups = cases_near_the_bound()
    cases = [case for group in groups for case in group]
    errors = bench.Errors.of(groups, [bench.estimates(group, bench.CONTINUOUS, False, False) for group in groups])
    ratio = math.sqrt(np.mean(errors.errors**2)) / bench.limit(cases, bench.CONTINUOUS, voltage=False)
    assert 0.4 < ratio < 1.6
