"""Another reference in a running simulation: as if it had been laid out from the start."""

import math

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SignalLike, SquareWave, Step
from servotwin.simulation import Run, Simulation, simulate
from servotwin.simulation.inputs import about, raised, spliced

PAPER = Servo.preset("paper")
RATES = [None, 1000.0, 200.0]
SIGNALS: list[SignalLike] = [0.0, 1e-4, SquareWave(2e-4, 0.7), SCurve(0.0, 3e-4, 1.0, 0.5), Step(-1e-4, 1.3)]
COEFFICIENTS = st.lists(st.floats(-2.0, 2.0), min_size=4, max_size=4)


@st.composite
def cubics(draw: st.DrawFn) -> PiecewiseCubic:
    times = [0.0, *sorted(draw(st.sets(st.integers(1, 40), max_size=5)))]
    return PiecewiseCubic([0.1 * t for t in times], [draw(COEFFICIENTS) for _ in times])


def options_of(rate: float | None, **changes: object) -> dict:
    noise = None if rate is None else Noise(std=1e-6)
    controller = PAPER.controller.replace(sample_rate=rate)
    gap, tolerance = math.radians(5.0), PAPER.tolerance_for(math.radians(1.0))
    return {
        "controller": controller,
        "gap": gap,
        "tolerance": tolerance,
        "sample_rate": 1000.0,
        "noise": noise,
    } | changes


def changed_at(samples: list[int], references: list[SignalLike], **options: object) -> Run:
    simulation = Simulation(PAPER, 2.0, **options)
    for sample, reference in zip(samples, references, strict=True):
        simulation.advance(sample)
        simulation.set_reference(reference)
    simulation.advance(simulation.samples - 1)
    return simulation.run()


def pieces(signal: SignalLike) -> PiecewiseCubic:
    return PiecewiseCubic.constant(signal) if isinstance(signal, float) else signal.pieces(2.0)


@pytest.mark.slow
@examples(40, deadline=None)
@given(
    rate=st.sampled_from(RATES),
    signals=st.tuples(*[st.sampled_from(SIGNALS)] * 3),
    places=st.tuples(st.integers(1, 1998), st.integers(1, 1998)),
)
def test_as_if_laid_out_from_the_start(
    rate: float | None, signals: tuple[SignalLike, ...], places: tuple[int, int]
) -> None:
    first, second = sorted(places)
    options = options_of(rate)
    found = changed_at([first, second], list(signals[1:]), reference=signals[0], **options)
    whole = spliced(pieces(signals[0]), pieces(signals[1]), first / 1000.0)
    planned = simulate(PAPER, 2.0, reference=spliced(whole, pieces(signals[2]), second / 1000.0), **options)
    assert np.array_equal(found.reference, planned.reference)
    for name in ("position", "theta_m", "voltage", "measured_position"):
        a, b = getattr(found, name), getattr(planned, name)
        assert np.allclose(a, b, rtol=0.0, atol=1e-9 * max(1e-4, float(np.max(np.abs(b))))), name
    assert [event.kind for event in found.events] == [event.kind for event in planned.events]


@pytest.mark.parametrize("rate", RATES)
def test_a_change_to_what_runs_changes_nothing(rate: float | None) -> None:
    wave = SquareWave(2e-4, 0.7)
    plain, same = simulate(PAPER, 2.0, reference=wave, **options_of(rate)), None
    same = changed_at([777], [wave], reference=wave, **options_of(rate))
    assert np.allclose(plain.position, same.position, rtol=0.0, atol=1e-15)


def test_the_present_sample_has_the_new_reference_and_the_past_keeps_its_own() -> None:
    simulation = Simulation(PAPER, 1.0, reference=1e-4, **options_of(1000.0))
    simulation.advance(500)
    simulation.set_reference(2e-4)
    simulation.advance(600)
    assert set(simulation.measured("reference", 0, 500)) == {1e-4}
    assert set(simulation.measured("reference", 500, 601)) == {2e-4}


def test_what_is_no_signal_is_refused() -> None:
    with pytest.raises(InvalidInput, match="is not a signal"):
        Simulation(PAPER, 1.0).set_reference("up")  # type: ignore[arg-type]


@given(cubics(), cubics(), st.floats(0.0, 5.0))
def test_sums_and_splices_have_the_values_they_should(one: PiecewiseCubic, two: PiecewiseCubic, time: float) -> None:
    t = np.linspace(0.0, 6.0, 97)
    assert np.allclose(raised(one, 0.25).value(t), one.value(t) + 0.25, rtol=1e-9, atol=1e-9)
    both = spliced(one, two, time)
    apart = t[np.abs(t - time) > 1e-9]
    assert np.allclose(both.value(apart), np.where(apart < time, one.value(apart), two.value(apart)), atol=1e-9)
    value = ((about(one, time)[3] * 0.01 + about(one, time)[2]) * 0.01 + about(one, time)[1]) * 0.01
    if not np.any((one.times > time) & (one.times <= time + 0.011)):
        assert value + about(one, time)[0] == pytest.approx(float(one.value(time + 0.01)), rel=1e-9, abs=1e-9)


@given(st.floats(-1e-2, 1e-2), st.floats(-1e-3, 1e-3))
def test_a_move_of_a_constant_is_their_floating_sum(value: float, offset: float) -> None:
    """The edge expects its reference to the last bit."""
    simulation = Simulation(PAPER, 0.3, reference=value, **options_of(1000.0))
    for index, moved in ((100, offset), (200, 0.0), (300, offset)):
        simulation.advance(index)
        simulation.move(moved)
    expected = [value] * 100 + [value + offset] * 100 + [value] * 100
    assert simulation.measured("reference", 0, 300).tolist() == expected


@pytest.mark.parametrize("rate", [None, 1000.0])
def test_a_move_adds_to_a_moving_reference_and_ends_without_a_trace(rate: float | None) -> None:
    planned = SCurve(0.0, 1e-3, duration=0.4)
    runs = [Simulation(PAPER, 0.5, reference=planned, **options_of(rate)) for _ in range(2)]
    for index, offset in ((200, 2e-4), (300, 0.0)):
        runs[0].advance(index)
        runs[0].move(offset)
    for run in runs:
        run.advance(500)
    moved, plain = (run.measured("reference", 0, 500) for run in runs)
    np.testing.assert_allclose(moved[200:300] - plain[200:300], 2e-4, rtol=1e-9)
    assert np.array_equal(moved[:200], plain[:200])
    np.testing.assert_allclose(moved[300:], plain[300:], rtol=1e-12)
