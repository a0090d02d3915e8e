"""The simulation against scipy's integrators on servos drawn at random, written anew from the paper's equations."""

from dataclasses import replace

import numpy as np
import pytest
from exploration import extent
from paper_loop import Case, by_exponentials, by_solve_ivp

from servotwin.errors import InvalidInput
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SquareWave
from servotwin.simulation import Run, simulate

DEGREE = np.pi / 180.0
TIMES = np.linspace(0.0, 20.0, 201)
# A run whose position moves by more than this part of the amplitude, when the amplitude changes by 1e-12 of it, cannot
# be compared to 1e-8.
SENSITIVE = 1e-9
SEEDS = extent(10, 64)


def random_servo(rng: np.random.Generator) -> Servo:
    """2, 3 or 5 unequal masses, another motor, other gains; stable without a gap."""
    while True:
        n = int(rng.choice([2, 3, 5]))
        stiffer = (n / 3.0) ** 2
        values = {
            "n": n,
            "m": tuple(5.2 * rng.uniform(0.6, 1.6, n)),
            "k": tuple(1e4 * stiffer * rng.uniform(0.6, 1.6, n)),
            "c": tuple(36.9 * rng.uniform(0.5, 2.0, n)),
            "L": rng.uniform(3e-3, 1e-2),
            "J": 5e-6 * rng.uniform(0.5, 4.0),
            "R": 12.0 * rng.uniform(0.7, 1.5),
        }
        gains = {
            name: value * rng.uniform(0.6, 1.3) for name, value in (("Kp", 1377.7), ("Ki", 18907.6), ("Kd", -135.1))
        }
        servo = Servo.preset("paper").replace(**values, **gains)
        try:
            servo.check_loop()
        except InvalidInput:
            continue
        return servo


def random_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    servo = random_servo(rng)
    gap = np.zeros(4)
    gap[0] = rng.uniform(0.5, 15.0) * DEGREE
    if rng.random() < 0.6:
        rise = rng.uniform(0.2, 1.0) * gap[0]
        gap[2:] = 3.0 * rise / 20.0**2, -2.0 * rise / 20.0**3
    tolerance = servo.tolerance_for(gap[0]) * rng.uniform(0.3, 1.5) if rng.random() < 0.7 else 0.0
    return Case(servo, 1e-3 * rng.uniform(0.3, 3.0), float(rng.choice([5.0, 10.0, 20.0])), gap, tolerance)


def ours(case: Case) -> Run:
    return simulate(
        case.servo,
        case.duration,
        reference=SquareWave(case.amplitude, 2.0 * case.half_period),
        gap=PiecewiseCubic([0.0], [case.gap]),
        tolerance=case.tolerance or None,
        sample_rate=(len(TIMES) - 1) / case.duration,
    )


def sensitivity(case: Case) -> float:
    """How far, relative to the amplitude, 1e-12 of the amplitude moves the position."""
    moved = replace(case, amplitude=case.amplitude * (1.0 + 1e-12))
    return float(np.abs(ours(moved).position - ours(case).position).max() / case.amplitude)


@pytest.fixture(scope="module")
def cases() -> list[tuple[int, Case, float]]:
    """Seed, case, sensitivity."""
    return [(seed, random_case(seed), sensitivity(random_case(seed))) for seed in range(SEEDS)]


@pytest.mark.random
def test_most_random_runs_can_be_compared(cases: list[tuple[int, Case, float]]) -> None:
    assert sum(sensitive <= SENSITIVE for *_, sensitive in cases) >= 0.8 * SEEDS
    assert {case.servo.n for _, case, _ in cases} == {2, 3, 5}
    assert {(case.gap[2] > 0.0, case.tolerance > 0.0) for _, case, _ in cases} == {
        (a, b) for a in (0, 1) for b in (0, 1)
    }


@pytest.mark.slow
def test_against_solve_ivp(cases: list[tuple[int, Case, float]]) -> None:
    """DOP853 at 1e-12, restarted at every event: a gap that grows on 2, 3 and 5 masses, and one that does not."""
    calm = [(seed, case) for seed, case, sensitive in cases if sensitive <= SENSITIVE]
    growing = [next(each for each in calm if each[1].servo.n == n and each[1].gap[2] > 0.0) for n in (2, 3, 5)]
    for seed, case in [*growing, next(each for each in calm if each[1].gap[2] == 0.0)]:
        case = replace(case, duration=4.0)
        (expected, count), run = by_solve_ivp(case, 0.2 * TIMES), ours(case)
        assert np.abs(run.position - expected).max() < 1e-8 * case.amplitude, seed
        assert count == np.count_nonzero(run.events.state_triggered) >= 5, seed


@pytest.mark.slow
@pytest.mark.random
def test_against_exponentials(cases: list[tuple[int, Case, float]]) -> None:
    """scipy's expm on a grid and brentq, on all; the events agree in kind and time."""
    for seed, case, sensitive in cases:
        if sensitive > SENSITIVE:
            continue
        (expected, events), run = by_exponentials(case), ours(case)
        assert np.abs(run.position - expected(TIMES)).max() < 1e-8 * case.amplitude, seed
        found = run.events[run.events.state_triggered]
        assert [label for _, label in events] == list(found.kind), seed
        off = np.abs(found.time - [time for time, _ in events])
        # A bounce shorter than the oracle's step may separate by less than its rounding: to it that contact is at once.
        bounce = (found.kind == "contact") & (np.diff(found.time, prepend=-np.inf) < 2e-4)
        assert off[~bounce].max() < 1e-7, seed
        assert np.all(off[bounce] < 2e-4), seed


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "table1", "paper-gain2"])
def test_the_presets_against_exponentials(preset: str) -> None:
    servo = Servo.preset(preset)
    gap = np.array([2.0 * DEGREE, 0.0, 3.0 * 8.0 * DEGREE / 400.0, -2.0 * 8.0 * DEGREE / 8000.0])
    case = Case(servo, 1e-3, 10.0, gap, servo.tolerance_for(3.0 * DEGREE))
    assert sensitivity(case) < SENSITIVE
    expected, events = by_exponentials(case)
    run = ours(case)
    assert np.abs(run.position - expected(TIMES)).max() < 1e-8 * case.amplitude
    assert len(events) == np.count_nonzero(run.events.state_triggered) > 50


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"integral_only": True},
        {"velocity_feedforward": 150.0, "velocity_time": 0.08},
        {"notch_hz": 4.3, "integral_only": True},
        {"notch_hz": 6.0, "notch_damping": 0.3, "notch_depth": 0.4},
    ],
)
def test_what_the_paper_lacks_against_exponentials(changes: dict[str, float]) -> None:
    """Weak integral action, which the dead zone stops while the rest of the law acts on; or a velocity feedforward;
    or a notch, which rings on where the dead zone opens the loop."""
    compared = 0
    for seed in range(40, 60):
        drawn = random_case(seed)
        own = drawn.servo.controller
        law = own.replace(Ki=0.1 * own.Ki, **changes)
        case = replace(drawn, servo=drawn.servo.replace(controller=law))
        if not case.tolerance or sensitivity(case) > SENSITIVE:
            continue
        (expected, events), run = by_exponentials(case), ours(case)
        assert np.abs(run.position - expected(TIMES)).max() < 1e-8 * case.amplitude, seed
        found = run.events[run.events.state_triggered]
        assert [label for _, label in events] == list(found.kind), seed
        assert np.abs(found.time - [time for time, _ in events]).max() < 1e-7, seed
        compared += 1
        if compared == 2:
            return
    raise AssertionError(f"only {compared} cases could be compared")


def elastic_case(seed: int) -> Case:
    case = random_case(seed)
    return replace(case, servo=case.servo.replace(k_d=10.0 ** np.random.default_rng(seed).uniform(5.0, 6.5)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_elastic_screw_whose_load_acts_back(seed: int) -> None:
    case = elastic_case(seed)
    (expected, events), run = by_exponentials(case), ours(case)
    if sensitivity(case) <= SENSITIVE:
        assert np.abs(run.position - expected(TIMES)).max() < 1e-8 * case.amplitude
    found = run.events[run.events.state_triggered]
    assert [label for _, label in events[:10]] == list(found.kind[:10])


def test_stiff_screw_carries_the_first_mass() -> None:
    """q1 follows p theta_d the closer the stiffer the screw, as 1 / k_d."""
    servo, lags = Servo.preset("paper"), []
    for k_d in (1e6, 1e7, 1e8):
        run = simulate(servo.replace(k_d=k_d), 4.0, reference=SCurve(0.0, 1e-3, 2.0))
        lags.append(np.abs(run.q[:, 0] - servo.p * run.theta_d).max())
    slopes = np.log10(lags[:-1]) - np.log10(lags[1:])
    assert np.all((slopes > 0.9) & (slopes < 1.1)), lags
