"""Another controller in a running simulation: no jump of the voltage, nothing else disturbed, the offset fades."""

import math

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import Run, Simulation

PAPER = Servo.preset("paper")
OLD = PAPER.controller
RATES = [None, 1000.0]


def swapping(at: int, new: Controller | None, width: float | None = None, **options: object) -> Run:
    """A run with another controller from sample `at` on; None: cut there all the same."""
    simulation = Simulation(PAPER, options.pop("duration", 4.0), **options)
    simulation.advance(at)
    if new is not None:
        simulation.set_controller(new, width)
    simulation.advance(simulation.samples - 1)
    return simulation.run()


def options_of(rate: float | None, **changes: object) -> dict:
    gap = math.radians(8.0)
    return {
        "controller": OLD.replace(sample_rate=rate),
        "reference": SquareWave(1e-3, 2.5),
        "gap": SCurve(0.0, gap, 4.0),
        "tolerance": PAPER.tolerance_for(0.3 * gap),
        "sample_rate": 1000.0,
    } | changes


@pytest.mark.slow
@examples(40)
@given(
    at=st.integers(1, 3999),
    rate=st.sampled_from(RATES),
    factors=st.tuples(*[st.floats(0.2, 2.0)] * 4),
    ki=st.sampled_from([0.0, 300.0, OLD.Ki]),
    feedforward=st.sampled_from([0.0, 0.05]),
    width=st.sampled_from([None, 0.0, 0.5, 3.0]),
    filters=st.tuples(*[st.sampled_from([None, 20.0])] * 2),
    friction=st.sampled_from([0.0, 0.003]),
    noisy=st.booleans(),
    integral_only=st.booleans(),
    velocities=st.tuples(*[st.sampled_from([0.0, 180.0])] * 2),
    notches=st.sampled_from([(0.0, 0.0), (0.0, 4.0), (4.0, 0.0), (4.0, 6.0)]),
)
def test_the_voltage_does_not_jump(
    at: int,
    rate: float | None,
    factors: tuple[float, ...],
    ki: float,
    feedforward: float,
    width: float | None,
    filters: tuple[float | None, float | None],
    friction: float,
    noisy: bool,
    integral_only: bool,
    velocities: tuple[float, float],
    notches: tuple[float, float],
) -> None:
    """Against the same run without the change, at the sample of the change: the inputs are identical there."""
    options = options_of(rate, friction=friction, noise=Noise(std=1e-5) if noisy else None)
    options["controller"] = options["controller"].replace(
        loop_filter_hz=filters[0], velocity_feedforward=velocities[0], notch_hz=notches[0]
    )
    new = OLD.replace(
        Kp=factors[0] * OLD.Kp,
        Ki=ki,
        Kd=factors[1] * OLD.Kd,
        Tf=factors[2] * OLD.Tf,
        leave=1.0 + factors[3],
        feedforward=feedforward,
        integral_only=integral_only,
        velocity_feedforward=velocities[1],
        notch_hz=notches[1],
        sample_rate=rate,
        loop_filter_hz=filters[0] if rate else filters[1],
    )
    tolerance = None if width is None else width * options["tolerance"]
    kept, changed = swapping(at, None, **options), swapping(at, new, tolerance, **options)
    assert np.array_equal(changed.position[: at + 1], kept.position[: at + 1])
    assert np.array_equal(changed.voltage[:at], kept.voltage[:at])
    assert abs(changed.voltage[at] - kept.voltage[at]) <= 1e-9


@examples(15)
@given(
    at=st.integers(1, 3999), rate=st.sampled_from(RATES), noisy=st.booleans(), friction=st.sampled_from([0.0, 0.003])
)
def test_the_same_controller_changes_nothing(at: int, rate: float | None, noisy: bool, friction: float) -> None:
    options = options_of(rate, noise=Noise(std=1e-5) if noisy else None, friction=friction)
    law = options["controller"]
    kept = swapping(at, None, **options)
    assert np.array_equal(swapping(at, law.replace(), **options).position, kept.position)
    again = swapping(at, law.replace(), options["tolerance"], **options)
    assert np.abs(again.position - kept.position).max() < 1e-12
    assert np.abs(again.voltage - kept.voltage)[: at + 1].max() < 1e-12
    assert again.events.kind.tolist() == kept.events.kind.tolist()


def test_the_linear_loop_agrees_with_expm() -> None:
    """Without gap and dead zone: two linear loops, the second with its states and with the offset that fades."""
    old, new = OLD.replace(feedforward=0.05), OLD.replace(Kp=0.5 * OLD.Kp, Ki=300.0, Kd=0.7 * OLD.Kd, release_time=0.3)
    plant, reference, at, step = PAPER.plant(), 1e-3, 137, 0.01
    size = plant.B.size

    def loop(law: Controller) -> tuple[np.ndarray, np.ndarray]:
        """Flow and voltage row of (plant, integral, derivative, offset, 1)."""
        one, error = np.zeros(size + 4), np.zeros(size + 4)
        one[-1], error[:size], error[-1] = 1.0, -plant.C, reference
        slope = error - np.eye(size + 4)[size + 1]
        voltage = law.Kp * error + law.Kd / law.Tf * slope + law.feedforward * one
        voltage[size] += 1.0
        voltage[size + 2] += 1.0
        flow = np.zeros((size + 4, size + 4))
        flow[:size, :size] = plant.A
        flow[:size] += np.outer(plant.B, voltage)
        flow[size], flow[size + 1] = law.Ki * error, slope / law.Tf
        flow[size + 2, size + 2] = -1.0 / law.release_time
        return expm(flow * step), voltage

    first, second = loop(old), loop(new)
    x, position, voltage = np.zeros(size + 4), [], []
    x[-1] = 1.0
    for k in range(401):
        if k == at:
            x[size + 2] += (first[1] - second[1]) @ x
        advance, row = first if k < at else second
        position.append(plant.C @ x[:size])
        voltage.append(row @ x)
        x = advance @ x
    run = swapping(at, new, controller=old, reference=reference, sample_rate=100.0)
    assert np.abs(run.position - position).max() < 1e-10 * np.abs(position).max()
    assert np.abs(run.voltage - voltage).max() < 1e-9 * np.abs(voltage).max()


@pytest.mark.parametrize("rate", RATES)
def test_without_integral_action_the_limit_cycle_ends(rate: float | None) -> None:
    """The volts that the integral held fade with the offset; nothing of them stays."""
    options = options_of(rate, tolerance=None, gap=math.radians(10.0), reference=1e-3, duration=60.0, sample_rate=100.0)
    run = swapping(2000, OLD.replace(Ki=0.0, sample_rate=rate), **options)
    assert np.ptp(run.position[1500:2000]) > 3e-4
    assert np.abs(run.reference - run.position)[5900:].max() < 1e-9
    assert np.abs(run.voltage[5900:]).max() < 1e-6


def test_the_sampled_swap_converges_to_the_continuous_one() -> None:
    new = OLD.replace(Ki=200.0, Kp=0.6 * OLD.Kp, feedforward=0.03)
    options = options_of(None, tolerance=None, duration=1.0, gap=math.radians(3.0), sample_rate=500.0)
    exact = swapping(250, new, **options).position
    errors = []
    for rate in (4000.0, 8000.0, 16000.0):
        law = OLD.replace(sample_rate=rate)
        run = swapping(250, new.replace(sample_rate=rate), **(options | {"controller": law}))
        errors.append(np.abs(run.position - exact).max())
    assert 1.6 < errors[0] / errors[1] < 2.4
    assert 1.6 < errors[1] / errors[2] < 2.4


@pytest.mark.parametrize("rate", RATES)
def test_limits_old_and_new(rate: float | None) -> None:
    """From saturation nothing jumps; a smaller limit cuts at once."""
    options = options_of(rate, tolerance=None)
    options["controller"] = options["controller"].replace(voltage_limit=0.5)
    before = swapping(30, None, **options)
    assert before.voltage[30] == 0.5
    for limit, expected in ((None, 0.5), (1.0, 0.5), (0.2, 0.2)):
        new = OLD.replace(Kp=0.5 * OLD.Kp, sample_rate=rate, voltage_limit=limit)
        assert swapping(30, new, **options).voltage[30] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("rate", RATES)
def test_many_swaps_in_one_run(rate: float | None) -> None:
    """Channels and events of one run, whatever the number of its controllers."""
    simulation = Simulation(PAPER, 4.0, **options_of(rate, friction=0.003))
    for k in range(1, 40):
        simulation.advance(100 * k)
        before = simulation.measured("position", 100 * k, 100 * k + 1)
        simulation.set_controller(OLD.replace(Ki=(k % 3) * 300.0, sample_rate=rate), (k % 4) * 1e-5)
        assert simulation.measured("position", 100 * k, 100 * k + 1) == pytest.approx(before, rel=1e-13)
    simulation.advance(4000)
    run = simulation.run()
    assert run.position.shape == run.voltage.shape == run.q[:, 0].shape == (4001,)
    assert np.abs(np.diff(run.position)).max() < 5e-5
    assert np.all(np.diff(run.events.time) >= 0.0)
    assert run.tolerance[[99, 100, 399, 400]] == pytest.approx(
        [PAPER.tolerance_for(math.radians(2.4)), 1e-5, 3e-5, 0.0]
    )
    changes = run.events[np.isin(run.events.kind, ["stick", "slip"])]
    assert len(changes) > 4
    assert set(changes.kind[::2]) == {"slip"}
    assert set(changes.kind[1::2]) == {"stick"}


@pytest.mark.parametrize("rate", RATES)
def test_what_cannot_be_swapped_is_refused(rate: float | None) -> None:
    simulation = Simulation(PAPER, 1.0, controller=OLD.replace(sample_rate=rate))
    other = 500.0 if rate is None else None
    with pytest.raises(InvalidInput, match="sample_rate: a running simulation cannot go from"):
        simulation.set_controller(OLD.replace(sample_rate=other))
    with pytest.raises(InvalidInput, match="has no dead zone"):
        simulation.set_controller(OLD.replace(sample_rate=rate), 1e-5)
    if rate is None:
        with pytest.raises(InvalidInput, match="rate_limit needs a sampled controller"):
            simulation.set_controller(OLD.replace(rate_limit=1.0))
