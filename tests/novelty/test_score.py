"""The score of a window: the gap that it shows, its spread, and what it does not show."""

from __future__ import annotations

import math
from array import array
from functools import cache

import numpy as np
import pytest
from scaling import Units, scaled
from scipy.signal import lsim

import servotwin
from benchmarks.estimator_windows import WindowCase, paper_loop_cases
from servotwin.errors import InvalidInput
from servotwin.estimation.core.response import response
from servotwin.estimation.window import Window
from servotwin.novelty.score import EncoderOffset, Score, leads_at_rest, model_of, response_of, score
from servotwin.novelty.settings import NoveltyModel, ResponseMode
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate

RATE = 5000.0
SERVO = Servo.preset("paper")
MODEL = model_of(SERVO, RATE)
UNEQUAL = SERVO.replace(n=4, m=(1.0, 2.0, 3.0, 1.5), k=(1e4, 2e4, 8e3, 1.2e4), c=(30.0, 40.0, 20.0, 10.0))


def walk(count: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).standard_normal(count)) * 0.01


@cache
def clean(gap_deg: float) -> tuple[WindowCase, ...]:
    return tuple(paper_loop_cases(np.radians([gap_deg]), 4, 1, None))


def scored(case: WindowCase, off_deg: float = 0.0, offset: EncoderOffset | None = None) -> Score:
    assert case.window.theta_m is not None
    angle, position = array("d", case.window.theta_m), array("d", case.window.position)
    found = score(angle, position, MODEL, max(0.0, case.gap + math.radians(off_deg)), offset)
    assert found is not None
    return found


@pytest.mark.parametrize("servo", [SERVO, UNEQUAL, Servo.preset("table1").replace(n=2)])
@pytest.mark.parametrize("rate", [500.0, 5000.0])
def test_the_stored_model_responds_as_the_twins_structure(servo: Servo, rate: float) -> None:
    model, known, angle = model_of(servo, rate), response(servo, rate), walk(1500)
    stored, exact = response_of(model), known.respond(angle[None])[0]
    assert np.allclose(stored.respond(angle[None])[0], exact, rtol=0.0, atol=1e-12 * np.abs(exact).max())
    assert np.allclose(stored.free(1500), known.free(1500), rtol=0.0, atol=1e-9)
    assert model.static_gain == known.static_gain


def test_the_stored_model_responds_as_the_linear_system() -> None:
    system, angle = SERVO.G2(), walk(2000)
    angle -= angle[0]
    time = np.arange(angle.size) / RATE
    _, exact, _ = lsim((system.A, system.B[:, None], system.C[None], system.D), angle, time, interp=True)
    found = response_of(MODEL).respond(angle[None])[0]
    assert np.abs(found - exact).max() < 1e-10 * np.abs(exact).max() + 1e-15


@pytest.mark.parametrize(
    "units", [Units(time=2.0**-10), Units(time=1e3), Units(length=1e-6), Units(2.0**7, 2.0**20, 4.0)]
)
def test_a_machine_in_other_units_has_the_same_score(units: Units) -> None:
    model = model_of(scaled(SERVO, *units), RATE / units.time)
    assert model.second == pytest.approx(units.time)
    assert model.factor == MODEL.factor
    still = np.abs(np.arange(1500) - 750) < 400
    for case in clean(10.0)[:2]:
        theta_m, position = case.window.theta_m, case.window.position
        assert theta_m is not None
        here = score(theta_m, position, MODEL, math.radians(9.0))
        there = score(theta_m, units.length * position, model, math.radians(9.0))
        assert here is not None
        assert there is not None
        assert there.gap == pytest.approx(here.gap, rel=1e-9)
        assert there.travel == pytest.approx(here.travel)
        assert there.noise / units.length == pytest.approx(here.noise, rel=1e-3)
    angle = np.where(still, 0.3, walk(1500))
    leads = [
        leads_at_rest(angle, one.static_gain * 0.1 * np.ones(1500), one.rate * one.second, one.static_gain, 1e-3)
        for one in (MODEL, model)
    ]
    assert leads[0] == pytest.approx(leads[1])
    assert leads[0]


def test_a_ball_screw_with_a_fine_encoder_shows_small_changes() -> None:
    """A lost motion of 5 um, 0.36 deg, in steps of 100 um, a million counts per turn, from 30 % off."""
    lost_motion, step = 5e-6, 1e-4
    law, pitch, count = SERVO.controller, 5e-3 / (2.0 * math.pi), 2.0 * math.pi / 2**20
    servo = SERVO.replace(p=pitch, Kp=law.Kp * SERVO.p / pitch, Ki=0.0, Kd=law.Kd * SERVO.p / pitch)
    truth = lost_motion / pitch
    run = simulate(servo, 12.0, reference=SquareWave(step, 4.0), gap=truth, sample_rate=RATE)
    model = model_of(servo.replace(encoder_resolution=count), RATE)
    for start in (1.7, 3.7, 5.7, 7.7, 9.7):
        window = Window.from_run(run, start, 2.0)
        assert window.theta_m is not None
        theta_m, position = np.round(window.theta_m / count) * count, np.round(window.position / 1e-8) * 1e-8
        for share in (0.7, 1.3):
            found = score(theta_m, position, model, share * truth)
            assert found is not None
            assert found.gap == pytest.approx(truth, abs=math.radians(5e-4))


@pytest.mark.parametrize("gap_deg", [4.0, 10.0, 18.0])
@pytest.mark.parametrize("off_deg", [0.0, 0.05, -0.5, 1.0, -3.0, 3.0, 5.0])
def test_a_change_is_recovered_without_noise(gap_deg: float, off_deg: float) -> None:
    errors = [math.degrees(scored(case, off_deg).gap - case.gap) for case in clean(gap_deg)]
    assert max(map(abs, errors)) < 1e-3, errors


@pytest.mark.slow
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
    theta_m, position = array("d", window.theta_m), array("d", window.position)
    alone = score(theta_m, position, MODEL, gap)
    assert alone is None or min(alone.travel) < math.radians(0.5)
    known = score(theta_m, position, MODEL, gap + 0.02, EncoderOffset(0.0, 1e-4))
    assert known is not None
    assert math.degrees(abs(known.gap - gap)) < 0.03


def test_a_window_without_motion_says_nothing() -> None:
    assert score([0.0] * 5000, [0.0] * 5000, MODEL, 0.1) is None
    assert score([1.0] * 5000, walk(5000).tolist(), MODEL, 0.1) is None
    assert score([0.0] * 10, [0.0] * 10, MODEL, 0.1) is None
    assert score([math.nan] * 5000, [0.0] * 5000, MODEL, 0.1) is None


def test_rests_show_the_lost_motion() -> None:
    angle, load = [0.0] * 1000 + [0.5] * 1000, [0.0] * 1000 + [0.3 * SERVO.p] * 1000
    leads = leads_at_rest(angle, load, 1000.0, SERVO.p, 1e-3)
    assert max(leads) - min(leads) == pytest.approx(0.2)
    assert leads_at_rest(walk(2000).tolist(), load, 1000.0, SERVO.p, 1e-3) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"rate": 0.0},
        {"rate": math.inf},
        {"modes": ()},
        {"modes": (ResponseMode(1.0 + 0j, 1j),)},
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
