"""Signals against their formulas; minima against dense sampling; jumps where and only where the value jumps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.plant.signals import (
    PiecewiseCubic,
    Samples,
    SCurve,
    SquareWave,
    Step,
    as_nonnegative,
    as_pieces,
    reference_changes,
)

NUMBERS = st.floats(-10.0, 10.0)


@st.composite
def cubics(draw: st.DrawFn) -> PiecewiseCubic:
    spans = draw(st.lists(st.floats(0.1, 3.0), max_size=4))
    times = np.concatenate([[-draw(st.floats(0.0, 1.0))], spans]).cumsum()
    coeffs = [[draw(NUMBERS) for _ in range(4)] for _ in times]
    return PiecewiseCubic(times, coeffs)


@given(begin_value=NUMBERS, end_value=NUMBERS, duration=st.floats(0.1, 100.0), begin=st.floats(-20.0, 20.0))
def test_s_curve_is_the_smoothstep(begin_value: float, end_value: float, duration: float, begin: float) -> None:
    t = np.linspace(0.0, 130.0, 521)
    u = np.clip((t - begin) / duration, 0.0, 1.0)
    expected = begin_value + (end_value - begin_value) * (3.0 * u**2 - 2.0 * u**3)
    pieces = SCurve(begin_value, end_value, duration, begin).pieces(130.0)
    np.testing.assert_allclose(pieces.value(t), expected, rtol=1e-12, atol=1e-12)
    assert pieces.jumps.size == 0


def test_step_now_and_later() -> None:
    now, later = Step(2.0).pieces(10.0), Step(2.0, at=3.0).pieces(10.0)
    np.testing.assert_array_equal(now.value([0.0, 5.0]), [2.0, 2.0])
    np.testing.assert_array_equal(later.value([0.0, 2.999, 3.0, 99.0]), [0.0, 0.0, 2.0, 2.0])


def test_square_wave_starts_with_the_first_half_and_is_right_continuous() -> None:
    wave = SquareWave(1e-3, 40.0, offset=1.0).pieces(200.0)
    np.testing.assert_array_equal(wave.value([0.0, 19.99, 20.0, 40.0, 200.0]), [1.001, 1.001, 0.999, 1.001, 1.001])
    np.testing.assert_array_equal(wave.jumps, np.arange(20.0, 201.0, 20.0))


def test_samples_are_held() -> None:
    held = Samples([1.0, 2.0, 4.0], [5.0, 6.0, 7.0]).pieces(10.0)
    np.testing.assert_array_equal(held.value([0.0, 1.5, 2.0, 3.99, 4.0, 50.0]), [5.0, 5.0, 6.0, 6.0, 7.0, 7.0])


def test_numbers_are_constant_signals() -> None:
    assert as_pieces(3, 10.0) == PiecewiseCubic.constant(3.0)
    assert as_pieces(np.float64(3.0), 10.0) == PiecewiseCubic.constant(3.0)


@pytest.mark.parametrize(
    ("signal", "expected"),
    [
        (SquareWave(1e-3, 40.0), np.arange(0.0, 200.0, 20.0)),
        (SquareWave(1e-3, 40.0, offset=-1e-3), np.arange(20.0, 200.0, 20.0)),  # starts at zero: nothing changes at 0
        (Step(1e-3), [0.0]),
        (Step(1e-3, at=7.0), [7.0]),
        (Step(1e-3, at=200.0), []),
        (Step(0.0, at=7.0), []),
        (0.0, []),
        (1.0, [0.0]),
        (SCurve(0.0, 1.0, 50.0, begin=3.0), []),
        (Samples([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 1.0, 0.0]), [1.0, 3.0]),
    ],
)
def test_reference_changes_are_its_jumps(signal, expected) -> None:  # type: ignore[no-untyped-def]
    np.testing.assert_array_equal(reference_changes(signal, 200.0), expected)


@given(cubics(), st.floats(0.0, 12.0))
def test_the_minimum_agrees_with_dense_sampling(signal: PiecewiseCubic, duration: float) -> None:
    time, value = signal.minimum(duration)
    t = np.linspace(0.0, duration, 20001)
    assert 0.0 <= time <= duration
    assert value <= np.min(signal.value(t)) + 1e-9 * (1.0 + abs(value))
    left = float(signal.value(time - 16.0 * np.spacing(time)))  # the limit from the left counts at a jump
    assert min(abs(left - value), abs(float(signal.value(time)) - value)) <= 1e-9 * (1.0 + abs(value))


def test_minimum_at_the_root_of_the_derivative() -> None:
    time, value = PiecewiseCubic([0.0], [[1.0, -3.0, 0.0, 1.0]]).minimum(5.0)  # t^3 - 3 t + 1
    assert (time, value) == (1.0, -1.0)


@given(cubics(), st.floats(0.25, 4.0))
def test_a_scaled_signal_has_scaled_values(signal: PiecewiseCubic, factor: float) -> None:
    t = np.linspace(0.0, 5.0, 101)
    np.testing.assert_allclose(signal.scaled(factor).value(t), factor * signal.value(t), rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(signal.scaled(2.0).jumps, signal.jumps)


@given(cubics())
def test_jumps_are_where_left_and_right_differ(signal: PiecewiseCubic) -> None:
    left = signal.value(signal.times[1:] - 16.0 * np.spacing(signal.times[1:]))
    right = signal.value(signal.times[1:])
    clearly = np.abs(left - right) > 1e-6
    assert set(signal.times[1:][clearly]) <= set(signal.jumps)


def test_continuous_pieces_do_not_jump() -> None:
    first = PiecewiseCubic([0.0], [[0.1, 0.3, -0.7, 0.9]])
    joined = PiecewiseCubic([0.0, 1.3], [[0.1, 0.3, -0.7, 0.9], [float(first.value(1.3)), 5.0, 0.0, 0.0]])
    assert joined.jumps.size == 0


def test_a_gap_that_goes_negative_is_refused_with_time_and_value() -> None:
    with pytest.raises(InvalidInput, match=r"gap = -1 rad at t = 1 s is negative; it must be 0 rad or more"):
        as_nonnegative(PiecewiseCubic([0.0], [[1.0, -3.0, 0.0, 1.0]]), 5.0)
    with pytest.raises(InvalidInput, match=r"tolerance = -0.002 m at t = 0 s"):
        as_nonnegative(-0.002, 5.0, "tolerance", "m")
    assert as_nonnegative(PiecewiseCubic([0.0], [[1.0, -3.0, 0.0, 1.0]]), 0.3).minimum(0.3)[1] > 0.0


@given(st.floats(1e-6, 1.0), st.floats(1.0, 300.0))
def test_a_gap_that_closes_is_not_refused_for_its_rounding(gap: float, duration: float) -> None:
    closing = as_nonnegative(SCurve(gap, 0.0, duration), 2.0 * duration)
    assert abs(closing.minimum(2.0 * duration)[1]) <= 1e-13 * gap


def test_signals_are_values() -> None:
    one, other = SCurve(0.0, 1.0, 5.0).pieces(1.0), SCurve(0.0, 1.0, 5.0).pieces(9.0)
    assert one == other
    assert hash(one) == hash(other)
    assert one != PiecewiseCubic.constant(1.0)
    assert one != 3
    assert Samples([0, 1], [2, 3]) == Samples((0.0, 1.0), (2.0, 3.0))
    with pytest.raises(ValueError, match="read-only"):
        one.times[0] = 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PiecewiseCubic([0.0, 1.0], [[1.0, 0.0, 0.0, 0.0]]), "needs times"),
        (lambda: PiecewiseCubic([], np.zeros((0, 4))), "needs times"),
        (lambda: PiecewiseCubic([0.0], [[1.0, 0.0, 0.0]]), "needs times"),
        (lambda: PiecewiseCubic([1.0], [[1.0, 0.0, 0.0, 0.0]]), "first must be 0 s or earlier"),
        (lambda: PiecewiseCubic([0.0, 0.0], np.zeros((2, 4))), "must increase"),
        (lambda: PiecewiseCubic([0.0], [[math.nan, 0.0, 0.0, 0.0]]), "coeffs of a piecewise cubic must be finite"),
        (lambda: PiecewiseCubic([-math.inf], [[0.0, 0.0, 0.0, 0.0]]), "times of a piecewise cubic must be finite"),
        (lambda: SCurve(0.0, math.inf, 1.0), "end_value = inf must be finite"),
        (lambda: SCurve(0.0, 1.0, 0.0), "duration = 0.0 s must be positive"),
        (lambda: SCurve(0.0, 1.0, 1e-300), "duration = 1e-300 s must lie between"),
        (lambda: SCurve(0.0, 1.0, 1e300), r"duration = 1e\+300 s must lie between"),
        (lambda: Step(math.nan), "size = nan"),
        (lambda: SquareWave(1.0, -2.0), "period = -2.0 s must be positive"),
        (lambda: Samples([0.0, 0.0], [1.0, 2.0]), "must increase"),
        (lambda: Samples([0.0], [1.0, 2.0]), "one value for each time, not 2 for 1"),
        (lambda: as_pieces("gap", 1.0), "'gap' is not a signal"),  # type: ignore[arg-type]
        (lambda: as_pieces(math.inf, 1.0), "must be finite"),
    ],
)
def test_bad_signals_are_refused(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InvalidInput, match=message):
        make()


@given(st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=4, unique=True), st.integers(0, 40), st.floats(-2.0, 6.0))
def test_values_on_increasing_times_are_the_values(knots: list[float], count: int, first: float) -> None:
    knots = sorted(knots)
    knots[0] = -abs(knots[0])
    pieces = PiecewiseCubic(knots, [[k, 0.0, 0.5 * (k > 1.0), 0.0] for k in knots])
    times = first + 0.1 * np.arange(count)
    assert np.array_equal(pieces.on(times), pieces.value(times))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_number_that_is_not_finite_is_named(value):
    with pytest.raises(InvalidInput, match=f"tolerance = {value} m: must be finite"):
        as_nonnegative(value, 1.0, "tolerance", "m")
