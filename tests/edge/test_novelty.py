"""The structure in plain floats, and what it says of a window's gap."""

from __future__ import annotations

import math
from array import array
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lsim

import servotwin
from benchmarks.estimator_windows import Case, paper_loop_cases
from servotwin.commissioning.novelty import model_of
from servotwin.edge.novelty.least_squares import burg, fit
from servotwin.edge.novelty.lost_motion import rests
from servotwin.edge.novelty.model import Mode, NoveltyModel, fixed
from servotwin.edge.novelty.motion import Place, play
from servotwin.edge.novelty.score import Offset, Score, score
from servotwin.errors import InvalidInput
from servotwin.estimation.core.contacts import BY_GAP, BY_START, Gap, contacts
from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.response import response
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo

RATE = 5000.0
SERVO = Servo.preset("paper")
MODEL = model_of(SERVO, RATE)
UNEQUAL = SERVO.replace(n=4, m=(1.0, 2.0, 3.0, 1.5), k=(1e4, 2e4, 8e3, 1.2e4), c=(30.0, 40.0, 20.0, 10.0))


def walk(count: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).standard_normal(count)) * 0.01


@cache
def clean(gap_deg: float) -> tuple[Case, ...]:
    return tuple(paper_loop_cases(np.radians([gap_deg]), 4, 1, None))


def scored(case: Case, off_deg: float = 0.0, offset: Offset | None = None) -> Score:
    assert case.window.theta_m is not None
    angle, position = array("d", case.window.theta_m), array("d", case.window.position)
    found = score(angle, position, MODEL, max(0.0, case.gap + math.radians(off_deg)), offset)
    assert found is not None
    return found


@pytest.mark.parametrize("servo", [SERVO, UNEQUAL, Servo.preset("table1").replace(n=2)])
@pytest.mark.parametrize("rate", [500.0, 5000.0])
def test_the_plain_response_is_the_twins(servo: Servo, rate: float) -> None:
    model, known, angle = model_of(servo, rate), response(servo, rate), walk(1500)
    exact = known.respond(angle[None])[0]
    assert np.allclose(model.respond(angle.tolist()), exact, rtol=0.0, atol=1e-12 * np.abs(exact).max())
    assert model.static_gain == known.static_gain


def test_the_plain_response_is_that_of_the_linear_system() -> None:
    system, angle = SERVO.G2(), walk(2000)
    angle -= angle[0]
    time = np.arange(angle.size) / RATE
    _, exact, _ = lsim((system.A, system.B[:, None], system.C[None], system.D), angle, time, interp=True)
    assert np.abs(np.array(MODEL.respond(angle.tolist())) - exact).max() < 1e-10 * np.abs(exact).max() + 1e-15


def test_decimation_steps_and_free_motions_are_the_twins() -> None:
    signal, reduce = walk(3000, 1), decimation(MODEL.factor)
    assert np.allclose(MODEL.decimated(signal.tolist()), reduce.rows(signal[None])[0], rtol=0.0, atol=1e-13)
    steps = np.zeros(3000)
    steps[700:] += 0.7
    steps[2100:] -= 1.3
    exact = reduce.rows(response(SERVO, RATE).respond(steps[None]))[0]
    stepped = fixed(MODEL, 3000).stepped([(700, 0.7), (2100, -1.3)], MODEL.factor)
    assert np.allclose(stepped, exact, rtol=0.0, atol=1e-14)
    free = reduce.rows(response(SERVO, RATE).free(3000))
    rows = fixed(MODEL, 3000).nuisances[1:]
    assert np.linalg.matrix_rank(np.vstack([free, rows]), tol=1e-9) == len(rows) == len(free)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 0.5), st.floats(-1.0, 1.0))
def test_play_and_its_sensitivities_are_the_twins(seed: int, gap: float, place: float) -> None:
    angle = walk(400, seed)
    angle -= angle[0]
    motion = play(angle.tolist(), Place(gap, place))
    seen = contacts(angle, Gap(gap, Place(gap, place).screw))
    assert np.allclose(motion.angle, seen[0], rtol=0.0, atol=1e-12)
    for steps, row, first in ((motion.by_gap, BY_GAP, 0.0), (motion.by_start, BY_START, 1.0)):
        signal = np.full(angle.size, first)
        for sample, size in steps:
            signal[sample:] += size
        assert np.array_equal(signal[1:], seen[row][1:]) or gap == 0.0


@pytest.mark.parametrize("gap_deg", [4.0, 10.0, 18.0])
@pytest.mark.parametrize("off_deg", [0.0, 0.05, -0.5, 1.0, -3.0, 3.0, 5.0])
def test_a_change_is_recovered_without_noise(gap_deg: float, off_deg: float) -> None:
    errors = [math.degrees(scored(case, off_deg).gap - case.gap) for case in clean(gap_deg)]
    assert max(map(abs, errors)) < 1e-3, errors


def test_in_the_papers_noise_the_spread_is_what_it_says() -> None:
    cases = paper_loop_cases(np.radians([6.0, 12.0]), 30, 5, Noise(0.22e-3))
    rng = np.random.default_rng(0)
    found = [scored(case.noisy(1e-6 * rng.standard_normal(case.window.position.size))) for case in cases]
    errors = np.array([s.gap - c.gap for s, c in zip(found, cases, strict=True)])
    stds = np.array([s.std for s in found])
    assert math.degrees(errors.std()) < 0.007
    assert abs(math.degrees(errors.mean())) < 0.003
    assert 0.7 < np.sqrt(np.mean((errors / stds) ** 2)) < 1.6


@pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, 2e-3), (-40.0, 0.5)])
def test_where_the_sensors_count_from_does_not_matter(shift: tuple[float, float]) -> None:
    case = clean(10.0)[1]
    assert case.window.theta_m is not None
    moved = case.window.replace(theta_m=case.window.theta_m + shift[0], position=case.window.position + shift[1])
    one, other = scored(case), scored(case.replaced(moved, case.servo))
    assert math.isclose(one.gap, other.gap, abs_tol=1e-7)
    assert math.isclose(other.offset.value - one.offset.value, shift[1] / SERVO.p - shift[0], abs_tol=1e-6)


def test_a_mirrored_window_has_the_same_gap() -> None:
    case = clean(10.0)[2]
    assert case.window.theta_m is not None
    mirrored = case.window.replace(theta_m=-case.window.theta_m, position=-case.window.position)
    one, other = scored(case, 1.0), scored(case.replaced(mirrored, case.servo), 1.0)
    assert math.isclose(one.gap, other.gap, abs_tol=1e-9)
    assert math.isclose(one.std, other.std, rel_tol=1e-3)
    assert one.travel == pytest.approx(other.travel[::-1])


def test_one_contact_says_something_only_where_the_offset_is_known() -> None:
    servo, gap = SERVO, math.radians(10.0)
    run = servotwin.simulate(
        servo, 4.0, controller=servo.controller.replace(Ki=0.0), reference=servotwin.Step(1e-3, 1.0), gap=gap
    )
    window = servotwin.Window.from_run(run, 0.8, 1.0)
    assert window.theta_m is not None
    signals = array("d", window.theta_m), array("d", window.position)
    alone = score(*signals, MODEL, gap)
    assert alone is None or min(alone.travel) < math.radians(0.5)
    known = score(*signals, MODEL, gap + 0.02, Offset(0.0, 1e-4))
    assert known is not None
    assert math.degrees(abs(known.gap - gap)) < 0.03


def test_a_window_without_motion_says_nothing() -> None:
    assert score([0.0] * 5000, [0.0] * 5000, MODEL, 0.1) is None
    assert score([1.0] * 5000, walk(5000).tolist(), MODEL, 0.1) is None
    assert score([0.0] * 10, [0.0] * 10, MODEL, 0.1) is None
    assert score([math.nan] * 5000, [0.0] * 5000, MODEL, 0.1) is None


def test_rests_show_the_lost_motion() -> None:
    angle, load = [0.0] * 1000 + [0.5] * 1000, [0.0] * 1000 + [0.3 * SERVO.p] * 1000
    leads = rests(angle, load, 1000.0, SERVO.p, 1e-3)
    assert max(leads) - min(leads) == pytest.approx(0.2)
    assert rests(walk(2000).tolist(), load, 1000.0, SERVO.p, 1e-3) == []


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 6))
def test_least_squares_are_numpys(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    columns, target = rng.standard_normal((count, 40)), rng.standard_normal(40)
    found = fit(columns.tolist(), target.tolist())
    exact, *_ = np.linalg.lstsq(columns.T, target, rcond=None)
    assert np.allclose(found.coefficients, exact)
    covariance = np.linalg.inv(columns @ columns.T)
    weights = rng.standard_normal(count)
    deviation = found.deviation(dict(enumerate(weights.tolist())))
    assert math.isclose(deviation, math.sqrt(weights @ covariance @ weights), rel_tol=1e-9)


def test_a_dependent_column_has_no_deviation() -> None:
    column = walk(30).tolist()
    found = fit([column, [2.0 * x for x in column]], column)
    assert found.coefficients == pytest.approx([1.0, 0.0])
    assert math.isinf(found.deviation({1: 1.0}))


def test_burg_finds_an_autoregression_and_whitens_it() -> None:
    rng, series = np.random.default_rng(3), np.zeros(4000)
    for i in range(2, series.size):
        series[i] = 1.5 * series[i - 1] - 0.8 * series[i - 2] + rng.standard_normal()
    found = burg(series.tolist(), 4, 0.0)
    assert found.filters[2] == pytest.approx([1.0, -1.5, 0.8], abs=0.05)
    white = np.array(found.whitened(series.tolist()))
    assert white.std() == pytest.approx(1.0, abs=0.05)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.05


@pytest.mark.parametrize(
    "changes",
    [
        {"rate": 0.0},
        {"rate": math.inf},
        {"modes": ()},
        {"modes": (Mode(1.0 + 0j, 1j),)},
        {"static_gain": 0.0},
        {"factor": 0},
        {"unseen": -1.0},
        {"direct": math.nan},
    ],
)
def test_a_model_that_makes_no_sense_is_refused(changes: dict[str, object]) -> None:
    values = {"rate": 5000.0, "modes": MODEL.modes, "direct": 0.0, "static_gain": 3e-4, "unseen": 0.05, "factor": 49}
    with pytest.raises(InvalidInput, match="novelty model"):
        NoveltyModel(**{**values, **changes})  # type: ignore[arg-type]


def test_an_elastic_screw_is_refused() -> None:
    with pytest.raises(InvalidInput, match="rigid"):
        model_of(SERVO.replace(k_d=1e6), RATE)
