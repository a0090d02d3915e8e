"""The play operator: closed forms, its algebra on random input, and where the paper's state machine jumps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from servotwin.errors import InvalidInput
from servotwin.plant.backlash import play, play_step
from servotwin.plant.signals import Array

ANGLES = hnp.arrays(float, st.integers(1, 60), elements=st.floats(-10.0, 10.0))
GAPS = st.floats(0.0, 5.0)
STARTS = st.floats(-10.0, 10.0)


def state_machine(theta_m: Array, omega_m: Array, theta_b: float, theta_d0: float) -> Array:
    """Fig 6 and Eqs 16-18 word for word on samples, theta_b as it stands there (half the total gap)."""
    theta_d = np.empty_like(theta_m)
    theta_d[0], closed, side = theta_d0, False, 0.0
    for i in range(1, theta_m.size):
        direction = np.sign(omega_m[i])
        if closed and direction * side < 0.0:  # Eq 17
            closed = False
        theta_d[i] = theta_d[i - 1]
        if not closed and abs(theta_m[i] - theta_d[i]) >= theta_b:  # Eq 18
            closed, side = True, direction
        if closed:
            theta_d[i] = theta_m[i] - side * theta_b  # Eq 16
    return theta_d


def fig_7(samples: int) -> tuple[Array, Array]:
    """theta_m of Eq 19, in rad (erratum E21), and omega_m, over 5 s."""
    t = np.linspace(0.0, 5.0, samples)
    sine, cosine = np.sin(2.0 * math.pi * t), np.cos(2.0 * math.pi * t)
    return (1.0 + t / 10.0) * sine, sine / 10.0 + (1.0 + t / 10.0) * 2.0 * math.pi * cosine


def jumps(theta_d: Array, half: float) -> Array:
    return np.flatnonzero(np.abs(np.diff(theta_d)) > half) + 1


@pytest.mark.parametrize("samples", [5001, 10001, 20011])
def test_the_literal_state_machine_jumps_by_the_full_width_at_reversals(samples: int) -> None:
    """Erratum E3: the speed has turned round, the angle not yet, so Eq 18 closes the gap on its far side at once."""
    half = math.radians(10.0)
    theta_m, omega_m = fig_7(samples)
    exact, literal = play(theta_m, 2.0 * half, 0.0), state_machine(theta_m, omega_m, half, 0.0)
    at = jumps(literal, half)
    assert at.size > 0
    np.testing.assert_allclose(literal[: at[0]], exact[: at[0]], atol=1e-14)  # until then they agree
    np.testing.assert_allclose(np.abs(literal[at] - literal[at - 1]), 2.0 * half, rtol=1e-3)
    assert np.all(omega_m[at] * omega_m[at - 1] < 0.0)  # only at reversals,
    assert np.all(omega_m[at - 1] * (theta_m[at] - theta_m[at - 1]) >= 0.0)  # and only where the angle lags the speed
    assert jumps(exact, half).size == 0
    assert np.max(np.abs(np.diff(exact))) <= np.max(np.abs(np.diff(theta_m))) + 1e-14


@pytest.mark.parametrize("samples", [1001, 5001, 10001])
def test_the_state_machine_with_finite_difference_speed_is_the_play_operator(samples: int) -> None:
    """Section 4.1's sampled version: the sign comes from the samples themselves, so angle and speed turn together."""
    half = math.radians(10.0)
    theta_m, _ = fig_7(samples)
    literal = state_machine(theta_m, np.diff(theta_m, prepend=theta_m[0]), half, 0.0)
    np.testing.assert_allclose(literal, play(theta_m, 2.0 * half, 0.0), atol=1e-14)


def test_the_total_gap_is_what_fig_7_calls_20_degrees() -> None:
    """Erratum E2: the lost motion, from one contact to the other, is the whole gap."""
    theta_m, _ = fig_7(50001)
    theta_d = play(theta_m, math.radians(20.0), 0.0)
    offset = theta_m - theta_d
    assert np.max(offset) - np.min(offset) == pytest.approx(math.radians(20.0), rel=1e-12)


@given(st.floats(0.1, 10.0), st.floats(0.0, 0.95))
def test_a_sine_in_closed_form(amplitude: float, share: float) -> None:
    """After the first quarter: at rest through the gap, then with the motor, half a gap behind."""
    half = share * amplitude
    t = np.linspace(0.0, 3.0, 3001)
    theta_d = play(amplitude * np.sin(2.0 * math.pi * t), 2.0 * half, 0.0)
    top = amplitude - half
    falling = (t >= 0.25) & (t <= 0.75)
    expected = np.minimum(top, amplitude * np.sin(2.0 * math.pi * t[falling]) + half)
    np.testing.assert_allclose(theta_d[falling], expected, atol=1e-12 * amplitude)
    rising = (t >= 0.75) & (t <= 1.25)
    expected = np.maximum(-top, amplitude * np.sin(2.0 * math.pi * t[rising]) - half)
    np.testing.assert_allclose(theta_d[rising], expected, atol=1e-12 * amplitude)


def test_a_growing_gap_never_moves_the_screw_and_a_shrinking_one_pushes_it() -> None:
    """Erratum E4: the motor rests in contact; the literal rule would drag the screw back (theta_m - side theta_b)."""
    resting = np.full(101, 1.0)
    growing = np.linspace(0.2, 0.8, 101)
    np.testing.assert_array_equal(play(resting, growing, 0.0), np.full(101, 0.9))
    shrinking = play(resting, growing[::-1], 0.0)
    np.testing.assert_allclose(shrinking, 1.0 - 0.5 * growing[::-1], atol=1e-15)
    assert shrinking[-1] > shrinking[0]


@given(ANGLES, GAPS, STARTS)
def test_the_screw_stays_inside_the_gap_and_moves_only_when_pushed(theta_m: Array, gap: float, start: float) -> None:
    theta_d = play(theta_m, gap, start)
    half = 0.5 * gap
    assert np.all(theta_d >= theta_m - half)
    assert np.all(theta_d <= theta_m + half)
    moved = np.flatnonzero(np.diff(theta_d)) + 1
    at_edge = (theta_d == theta_m - half) | (theta_d == theta_m + half)
    assert np.all(at_edge[moved])


@given(ANGLES, GAPS, STARTS, st.data())
def test_play_can_be_cut_anywhere(theta_m: Array, gap: float, start: float, data: st.DataObject) -> None:
    cut = data.draw(st.integers(1, theta_m.size))
    first = play(theta_m[:cut], gap, start)
    whole = play(theta_m, gap, start)
    np.testing.assert_array_equal(whole[:cut], first)
    if cut < theta_m.size:
        np.testing.assert_array_equal(whole[cut:], play(theta_m[cut:], gap, first[-1]))


@given(ANGLES, GAPS, STARTS, st.integers(2, 7))
def test_play_does_not_depend_on_the_rate(theta_m: Array, gap: float, start: float, refine: int) -> None:
    """Passing through the same angles slower, or resting on the way, changes nothing."""
    fine = np.interp(np.arange((theta_m.size - 1) * refine + 1) / refine, np.arange(theta_m.size), theta_m)
    fine[::refine] = theta_m
    np.testing.assert_array_equal(play(fine, gap, start)[::refine], play(theta_m, gap, start))
    np.testing.assert_array_equal(play(np.repeat(theta_m, refine), gap, start)[::refine], play(theta_m, gap, start))


@given(ANGLES, GAPS, STARTS, st.floats(-100.0, 100.0))
def test_shifting_the_motor_shifts_the_screw(theta_m: Array, gap: float, start: float, shift: float) -> None:
    np.testing.assert_allclose(play(theta_m + shift, gap, start + shift), play(theta_m, gap, start) + shift, atol=1e-12)


@given(ANGLES, GAPS, STARTS, st.integers(-8, 8))
def test_play_is_homogeneous_to_the_bit(theta_m: Array, gap: float, start: float, power: int) -> None:
    s = 2.0**power
    expected = s * play(np.round(theta_m, 3), round(gap, 3), round(start, 3))
    np.testing.assert_array_equal(play(s * np.round(theta_m, 3), s * round(gap, 3), s * round(start, 3)), expected)


@given(ANGLES, GAPS, STARTS, st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_play_is_monotone(theta_m: Array, gap: float, start: float, more: float, later: float) -> None:
    rise = np.linspace(0.0, more, theta_m.size)
    assert np.all(play(theta_m + rise, gap, start + later) >= play(theta_m, gap, start) - 1e-12)


@given(ANGLES, GAPS, STARTS)
def test_play_changes_by_at_most_half_the_change_of_the_gap(theta_m: Array, gap: float, start: float) -> None:
    """d theta_d / d(half gap) is -1, 0 or +1: a little more gap never moves the screw by more than half of it."""
    difference = play(theta_m, gap + 1e-3, start) - play(theta_m, gap, start)
    assert np.max(np.abs(difference)) <= 0.5e-3 + 1e-12


@pytest.mark.slow
@given(ANGLES, STARTS)
def test_no_gap_is_a_rigid_connection(theta_m: Array, start: float) -> None:
    np.testing.assert_array_equal(play(theta_m, 0.0, start), theta_m)


@given(ANGLES, STARTS, st.data())
def test_a_gap_for_each_sample(theta_m: Array, start: float, data: st.DataObject) -> None:
    gap = data.draw(hnp.arrays(float, theta_m.size, elements=GAPS))
    expected, now = [], start
    for angle, width in zip(theta_m, gap, strict=True):
        now = play_step(now, angle, 0.5 * width)
        expected.append(now)
    np.testing.assert_array_equal(play(theta_m, gap, start), expected)


def test_interpreted_and_compiled_step_agree() -> None:
    for args in ((0.0, 1.0, 0.25), (0.0, -1.0, 0.25), (0.1, 0.0, 0.25), (3.0, 0.0, 0.0)):
        assert play_step(*args) == play_step.py_func(*args)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("theta_m", "gap", "start", "message"),
    [
        ([0.0, 1.0], -0.1, 0.0, "gap = -0.1 rad at sample 0 is negative; it must be 0 rad or more"),
        ([0.0, 1.0], [0.1, -0.2], 0.0, "gap = -0.2 rad at sample 1 is negative"),
        ([0.0, 1.0], [0.1, 0.1, 0.1], 0.0, "theta_m .n,. and a gap that is a number or .n,."),
        ([[0.0, 1.0]], 0.1, 0.0, "theta_m .n,. and a gap"),
        ([0.0, math.nan], 0.1, 0.0, "must be finite, in rad"),
        ([0.0, 1.0], math.inf, 0.0, "must be finite, in rad"),
        ([0.0, 1.0], 0.1, math.nan, "must be finite, in rad"),
    ],
)
def test_bad_play_input_is_refused(theta_m: object, gap: object, start: float, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        play(theta_m, gap, start)  # type: ignore[arg-type]
