"""The kernel on an automaton made here: three modes, a cubic input, a tangential guard, jumps; what must not matter."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import servotwin.hybrid
from servotwin.hybrid.automaton import Array, Automaton, Guard, Mode
from servotwin.hybrid.trajectory import Jump, Trajectory

NAMES = ("x", "c", "c'", "c''", "c'''", "one")
X, C, ONE = (np.eye(6)[NAMES.index(name)] for name in ("x", "c", "one"))
IDLE, UP, DOWN = 0, 1, 2
RISE, FALL = 2.0, 0.5


@cache
def tank() -> Automaton:
    """x rises while the cubic c is positive, falls while it is not, and stays at zero when empty."""
    inputs = np.zeros((6, 6))
    inputs[[1, 2, 3], [2, 3, 4]] = 1.0
    rising, falling = inputs.copy(), inputs.copy()
    rising[0], falling[0] = RISE * ONE, -FALL * ONE
    fill, drain, empty = (
        Guard(C, UP, None, "fill", 1),
        Guard(-C, DOWN, None, "drain", -1),
        Guard(-X, IDLE, None, "empty"),
    )
    return Automaton(
        (Mode(inputs, (fill,), "idle"), Mode(rising, (drain,), "up"), Mode(falling, (fill, empty), "down")), NAMES
    )


def cubic(coefficients: Array) -> dict[int, float]:
    """The states of ``c(t) = sum coefficients[k] t**k``."""
    return {1 + k: float(value) for k, value in enumerate(coefficients * [1.0, 1.0, 2.0, 6.0])}


def start(coefficients: Array, x: float = 0.0) -> Array:
    state = np.zeros(6)
    state[0], state[5] = x, 1.0
    for index, value in cubic(coefficients).items():
        state[index] = value
    return state


def product(a: float, b: float, c: float) -> Array:
    """Ascending coefficients of (t - a)(t - b)(t - c)."""
    return np.polynomial.polynomial.polyfromroots([a, b, c])


def events(run: Trajectory) -> list[tuple[float, str]]:
    return [(time, label) for time, label, _, _ in run.events()]


@pytest.mark.parametrize("step", [1e-3, 0.05, 1.0])
def test_modes_follow_the_roots_of_the_cubic(step: float) -> None:
    a, b, c = 1.234, 2.345, 9.01
    run = Trajectory(tank(), start(product(a, b, c)), IDLE, step)
    run.advance(round(12.0 / step))
    full = RISE * (b - a)
    expected = [(a, "fill"), (b, "drain"), (b + full / FALL, "empty"), (c, "fill")]
    assert [label for _, label in events(run)] == [label for _, label in expected]
    for (time, _), (in_closed_form, _) in zip(events(run), expected, strict=True):
        assert time == pytest.approx(in_closed_form, rel=1e-13)
    time = np.array([0.5, 1.7, b, 3.0, 8.0, 11.0])
    level = [0.0, RISE * (1.7 - a), full, full - FALL * (3.0 - b), 0.0, RISE * (11.0 - c)]
    assert np.abs(run.at(time, X) - level).max() < 1e-12


def test_filling_again_before_empty() -> None:
    a, b, c = 1.0, 3.3, 4.1
    run = Trajectory(tank(), start(product(a, b, c)), IDLE, 0.01)
    run.advance(500)
    assert [label for _, label in events(run)] == ["fill", "drain", "fill"]
    assert run.at([5.0], X)[0] == pytest.approx(RISE * (b - a) - FALL * (c - b) + RISE * (5.0 - c), rel=1e-13)


@given(touch=st.floats(0.5, 9.5), far=st.floats(10.5, 20.0), step=st.sampled_from([1e-3, 0.013, 0.4]))
def test_tangential_guard(touch: float, far: float, step: float) -> None:
    """Above by 1e-9 of its size the guard is crossed twice, below never; touching is one or the other, consistently."""
    tangent = product(touch, touch, far)
    size = abs(tangent[0])
    shift = np.array([1e-9 * size, 0.0, 0.0, 0.0])
    samples = round(10.0 / step)
    below = Trajectory(tank(), start(tangent - shift), IDLE, step)
    below.advance(samples)
    assert events(below) == []
    above = Trajectory(tank(), start(tangent + shift), IDLE, step)
    above.advance(samples)
    assert [label for _, label in events(above)] == ["fill", "drain", "empty"][: len(above.events())]
    assert len(above.events()) >= 2
    half = np.sqrt(1e-9 * size / (far - touch))
    times = np.array([time for time, _ in events(above)[:2]])
    assert np.abs(times - [touch - half, touch + half]).max() < half * (half + 1e-5)
    exact = Trajectory(tank(), start(tangent), IDLE, step)
    exact.advance(samples)
    assert len(exact.events()) != 1
    assert all(abs(time - touch) < 1e-4 for time, _ in events(exact))


def test_roots_of_the_hump_are_exact() -> None:
    """c = (t - 2)^2 (t - 7) + d with c = 0 at 2 - h: the other roots follow from Vieta, all to rounding."""
    h = 1e-3
    d = h**2 * (5.0 + h)
    run = Trajectory(tank(), start(product(2.0, 2.0, 7.0) + d * np.eye(4)[0]), IDLE, 0.01)
    run.advance(650)
    # The two others solve t^2 - (9 + h) t + ... = 0, written for u = t - 2: u^2 - (5 + h) u + h (5 + h) = 0.
    sum_, product_ = 5.0 + h, h * (5.0 + h)
    second = 2.0 + 2.0 * product_ / (sum_ + np.sqrt(sum_**2 - 4.0 * product_))
    times = [time for time, _ in events(run)]
    assert times[0] == pytest.approx(2.0 - h, abs=1e-12)
    assert times[1] == pytest.approx(second, abs=1e-12)


@pytest.mark.parametrize("time", [0.5, 0.50005, 1.0 / 3.0, 0.7 + 1e-13, 1.0])
def test_jumps_on_and_off_the_grid(time: float) -> None:
    """From the jump on, the cubic is another one; samples are right-continuous."""
    run = Trajectory(tank(), start(np.array([-1.0, 0.0, 0.0, 0.0])), IDLE, 1e-3)
    run.advance(1500, [Jump(time, cubic(np.array([-0.25, 1.0, 0.0, 0.0]))), Jump(time + 0.4, {0: 5.0}, [DOWN] * 3)])
    found = run.events()
    assert [event[1] for event in found] == ["fill", "fill"]
    assert found[0][0] == pytest.approx(time + 0.25, rel=1e-12)
    assert not found[0][3]
    # The mode map sends it to "down", which the positive cubic leaves at once: that is the jump's doing.
    assert found[1][0] == pytest.approx(time + 0.4, rel=1e-12)
    assert found[1][3]
    samples = np.arange(1501) * 1e-3
    late = np.where(samples - time > -1e-12, samples - time, np.nan)
    c = np.where(np.isnan(late), -1.0, late - 0.25)
    x = np.where(late > 0.4 - 1e-12, 5.0 + RISE * (late - 0.4), RISE * np.maximum(late - 0.25, 0.0))
    assert np.abs(run.sampled(C) - c).max() < 1e-12
    assert np.abs(run.sampled(X) - np.nan_to_num(x)).max() < 1e-12


def test_jumps_at_one_instant_apply_in_order() -> None:
    run = Trajectory(tank(), start(np.array([-1.0, 0.0, 0.0, 0.0])), IDLE, 1e-3)
    run.advance(10, [Jump(0.005, {0: 1.0}, [DOWN] * 3), Jump(0.005, {0: 2.0}), Jump(0.01, {0: 3.0})])
    assert run.sampled(X)[5] == 2.0
    assert run.sampled(X)[10] == 3.0
    assert run.mode == DOWN
    assert run.events() == []


def test_jump_at_the_end_is_followed() -> None:
    run = Trajectory(tank(), start(np.array([-1.0, 0.0, 0.0, 0.0])), IDLE, 1e-3)
    run.advance(10, [Jump(0.01, {1: 1.0})])
    assert run.mode == UP
    assert run.events() == [(0.01, "fill", 1, True)]


def test_set_between_advances() -> None:
    run = Trajectory(tank(), start(np.array([-1.0, 0.0, 0.0, 0.0])), IDLE, 1e-3)
    run.advance(100)
    run.set({1: 1.0})
    run.advance(200)
    run.set({1: -1.0}, [IDLE] * 3)
    run.advance(300)
    assert events(run) == [(0.1, "fill")]
    assert run.sampled(X)[-1] == pytest.approx(RISE * 0.1, rel=1e-13)
    assert run.sampled(C)[[99, 100, 199, 200]].tolist() == [-1.0, 1.0, 1.0, -1.0]


ROOTS = (1.234, 2.345, 9.01)


@pytest.mark.parametrize("refine", [2, 4, 16])
def test_refining_the_search_changes_nothing(refine: int) -> None:
    plain, fine = (Trajectory(tank(), start(product(*ROOTS)), IDLE, 0.01, r) for r in (1, refine))
    plain.advance(1200)
    fine.advance(1200)
    assert np.abs(np.array([t for t, _ in events(plain)]) - [t for t, _ in events(fine)]).max() < 1e-12
    assert np.abs(plain.sampled(X) - fine.sampled(X)).max() < 1e-11


@given(cuts=st.lists(st.integers(0, 1200), max_size=12).map(sorted))
def test_how_a_run_is_cut_changes_nothing(cuts: list[int]) -> None:
    whole, cut = (Trajectory(tank(), start(product(*ROOTS)), IDLE, 0.01) for _ in range(2))
    whole.advance(1200)
    for sample in [*cuts, 1200]:
        cut.advance(sample)
        assert cut.samples == sample + 1
    assert [label for _, label in events(cut)] == [label for _, label in events(whole)]
    assert np.abs(np.array([t for t, _ in events(whole)]) - [t for t, _ in events(cut)]).max() < 1e-12
    assert np.abs(whole.sampled(X) - cut.sampled(X)).max() < 1e-11


def test_any_part_of_the_samples() -> None:
    run = Trajectory(tank(), start(product(*ROOTS)), IDLE, 0.003, refine=3)
    run.advance(3300)
    everything = run.sampled(X)
    assert everything.shape == (3301,)
    assert np.abs(everything - run.at(np.arange(3301) * 0.003, X)).max() < 1e-12
    rng = np.random.default_rng(1)
    for first, last in np.sort(rng.integers(0, 3302, (40, 2)), axis=1).tolist():
        assert np.array_equal(run.sampled(X, first, last), everything[first:last]), (first, last)
    buffer = np.empty(7)
    assert run.sampled(X, 100, 107, out=buffer) is buffer
    assert np.array_equal(buffer, everything[100:107])


@pytest.mark.parametrize("power", [-300, -41, 40, 200])
def test_powers_of_two_scale_bit_for_bit(power: int) -> None:
    runs = []
    for scale in (1.0, 2.0**power):
        run = Trajectory(tank(), start(product(*ROOTS), 0.7) * scale, DOWN, 0.007)
        run.advance(700)
        run.set({0: 0.3 * scale})
        run.advance(1700, [Jump(7.77, {1: -3.0 * scale})])
        runs.append(run)
    plain, scaled = runs
    assert plain.events() == scaled.events()
    assert len(plain.events()) == 4
    assert np.array_equal(plain.sampled(X) * 2.0**power, scaled.sampled(X))
    times = np.random.default_rng(2).uniform(0.0, 11.9, 300)
    assert np.array_equal(plain.at(times, X) * 2.0**power, scaled.at(times, X))


def test_the_kernel_knows_no_machine() -> None:
    words = re.compile(
        r"servo(?!twin)|motor|backlash|\bgap|dead.?zone|volt|screw|encoder|tolerance|spring|damper|torque|controller",
        re.IGNORECASE,
    )
    files = sorted(Path(servotwin.hybrid.__file__).parent.glob("*.py"))
    assert len(files) >= 5
    found = [
        f"{file.name}:{number}: {line}"
        for file in files
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        if words.search(line)
    ]
    assert found == []


def test_a_guard_that_is_zero_to_within_rounding_is_passed_in_whole_blocks() -> None:
    """What comes to rest at its guard (a motor on a flank) would otherwise be searched step by step for ever."""
    still = Mode(np.zeros((4, 4)), (Guard(np.array([1.0, 1.0, -1.0, 0.0]), 0, None, "never"),))
    run = Trajectory(Automaton((still,), ("a", "b", "c", "spare")), np.array([1.0, 1e-14, 1.0, 0.0]), 0, 1e-3)
    run.advance(128 * 100)
    assert not run.events()
    assert run.record.size[0] < 200


@pytest.mark.parametrize("half", np.linspace(0.5, 0.6, 8))
def test_a_drift_below_the_last_digit_does_not_stand_still_at_the_bound_of_rounding(half: float) -> None:
    """A motor that creeps onto its flank: within one step it does not move, and no block passed it either."""
    flow = np.zeros((5, 5))
    flow[0, 3], flow[0, 4] = 1.0, -1.0  # the rate is what is left of two large terms: it may be rounding
    creeping = Mode(flow, (Guard(np.array([1.0, -1.0, -1.0, 0.0, 0.0]), 1, None, "touch"),))
    screw, step, drive, drift = 5.4, 1e-3, 4.0, 4e-16
    # Just below the bound, so that the next step would be beyond it.
    rounding = 1e-13 * 2.0 * (screw + half + step * drive)
    start = np.array([screw + half + rounding, screw, half, drive + drift / step, drive])
    while start[0] - screw - half >= rounding:
        start[0] = np.nextafter(start[0], 0.0)
    assert start[0] + drift == start[0]
    run = Trajectory(Automaton((creeping, Mode(np.zeros((5, 5)))), ("a", "b", "c", "drive", "load")), start, 0, step)
    run.advance(128 * 100)
    assert [event[1] for event in run.events()] == ["touch"]
    assert run.record.size[0] < 400
