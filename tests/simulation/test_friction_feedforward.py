"""The friction feedforward in every engine: a voltage with the sign of the reference's last change."""

import math
from typing import Any

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SquareWave, as_pieces
from servotwin.plant.turns import turns_of
from servotwin.simulation import Simulation, simulate
from servotwin.simulation.ensemble import Cases, simulate_members
from servotwin.simulation.inputs import RunInputs
from servotwin.simulation.sampled_ensemble import SampledCases, simulate_sampled
from servotwin.simulation.to_and_fro import errors_to_and_fro
from tests.support.random_sampled import SampledCase

PAPER = Servo.preset("paper")
PUSH = 0.06
"""V."""
FRICTION = PUSH * PAPER.k_T / PAPER.R
"""N m, which that voltage stalls."""
PD = PAPER.controller.replace(Ki=0.0, Kp=0.7 * PAPER.controller.Kp, Kd=0.7 * PAPER.controller.Kd)
FED = PD.replace(friction_feedforward=PUSH)
GAP = math.radians(10.0)
SIZE, PERIOD = 4e-4, 4.0


def run(law: Controller, reference: Any, **options: Any) -> Any:
    """Two periods of 10 deg of gap."""
    return simulate(PAPER, 2.0 * PERIOD, controller=law, reference=reference, sample_rate=1000.0, **options)


@pytest.mark.parametrize("rate", [None, 1000.0])
def test_a_motor_whose_friction_is_fed_forward_moves_as_one_without_friction(rate: float | None) -> None:
    """Until the motor turns back the two voltages cancel, but for the time in which the current rises (83 us)."""
    law, reference = PD.replace(sample_rate=rate), SIZE
    free = run(law, reference, gap=GAP)
    fed = run(law.replace(friction_feedforward=PUSH), reference, gap=GAP, friction=FRICTION)
    turned = np.flatnonzero(np.diff(free.theta_m) < -1e-12)
    end = int(turned[0]) if turned.size else free.theta_m.size
    assert end > 200
    assert fed.theta_m[:end] == pytest.approx(free.theta_m[:end], abs=3e-5 * np.ptp(free.theta_m))
    assert fed.position[:end] == pytest.approx(free.position[:end], abs=3e-5 * SIZE)


def by_hand(law: Controller, **options: Any) -> Array:
    """Position of a square wave under a law whose plain feedforward is changed at every step of the reference."""
    simulation = Simulation(
        PAPER, 2.0 * PERIOD, controller=law, reference=SquareWave(SIZE, PERIOD), sample_rate=1000.0, **options
    )
    engine: Any = simulation.engine
    for half in range(4):
        engine.controller = law.replace(feedforward=law.feedforward + PUSH * (-1) ** half)
        engine.parameters = engine.controller.law(None)
        simulation.advance(min(round((half + 1) * 500.0 * PERIOD), simulation.samples - 1))
    return simulation.run().position


@pytest.mark.parametrize("noise", [None, Noise(std=1e-6, kind="white")])
def test_the_tick_adds_it_at_every_step_of_the_reference(noise: Noise | None) -> None:
    law, options = PD.replace(sample_rate=1000.0, feedforward=0.01), {"gap": GAP, "friction": FRICTION, "noise": noise}
    fed = run(law.replace(friction_feedforward=PUSH), SquareWave(SIZE, PERIOD), **options)
    # Without noise the run is made in blocks, so that rounding differs.
    assert fed.position == pytest.approx(by_hand(law, **options), abs=1e-9 * SIZE)


@pytest.mark.parametrize("changes", [{}, {"velocity_feedforward": 150.0}, {"voltage_limit": 0.3, "feedforward": -0.02}])
def test_blocks_are_those_of_the_ticks(changes: dict[str, float]) -> None:
    law = FED.replace(sample_rate=1000.0, **changes)
    pieces = PiecewiseCubic.zero_order_hold([0.0, 0.5, 2.0, 2.0105, 5.0], [0.0, SIZE, SIZE, -SIZE, 0.0])
    inputs = RunInputs(pieces, PiecewiseCubic.constant(GAP), None, 1000.0, 0.01, FRICTION)
    case = SampledCase(PAPER, law, inputs, 0.02, 8001, 2)
    ticked, blocks = case.ticked(), case.in_blocks()
    for name in ("position", "theta_m", "voltage"):
        exact = ticked.channel(name, 0, 8001)
        assert blocks.channel(name, 0, 8001) == pytest.approx(exact, abs=1e-8 * np.ptp(exact))


@pytest.mark.parametrize(
    "reference",
    [
        SquareWave(SIZE, PERIOD),
        SCurve(0.0, SIZE, 2.0),
        PiecewiseCubic([0, 1, 2], [[0, SIZE, 0, 0], [SIZE, -SIZE, 0, 0], [0] * 4]),
    ],
)
def test_a_fast_tick_tends_to_the_continuous_loop(reference: Any) -> None:
    options = {"gap": GAP, "friction": FRICTION, "input_bias": 0.01, "theta_d0": 0.01}
    continuous = run(FED, reference, **options)
    sampled = run(FED.replace(sample_rate=20_000.0), reference, **options)
    assert sampled.position == pytest.approx(continuous.position, abs=2e-3 * SIZE)
    plain = run(PD, reference, **options)
    assert float(np.abs(plain.position - continuous.position).max()) > 0.05 * SIZE


def test_turns_of_a_cubic_are_where_its_slope_changes_its_sign() -> None:
    """t (t - 1) (t - 2) turns at 1 -+ 1 / sqrt(3); then it jumps up, rests, and falls."""
    pieces = PiecewiseCubic([0.0, 2.0, 3.0], [[0.0, 2.0, -3.0, 1.0], [1.0, 0.0, 0.0, 0.0], [1.0, 0.0, -1.0, 0.0]])
    times, signs = zip(*turns_of(pieces), strict=True)
    assert times == pytest.approx([0.0, 1.0 - 1.0 / math.sqrt(3.0), 1.0 + 1.0 / math.sqrt(3.0), 2.0, 3.0], abs=1e-12)
    assert signs == (1.0, -1.0, 1.0, 1.0, -1.0)


def test_a_changed_law_and_a_changed_reference_go_on_in_the_direction_of_the_last_change() -> None:
    """Both engines, beside one another: a step, another push, a step back, none."""
    runs = []
    for rate in (None, 20_000.0):
        law = FED.replace(sample_rate=rate, release_time=0.05)
        simulation = Simulation(
            PAPER, 8.0, controller=law, reference=SIZE, gap=GAP, friction=FRICTION, sample_rate=1000.0
        )
        simulation.advance(2000)
        simulation.set_controller(law.replace(friction_feedforward=0.5 * PUSH))
        simulation.advance(4000)
        simulation.set_reference(-SIZE)
        simulation.advance(6000)
        simulation.set_controller(law.replace(friction_feedforward=0.0))
        simulation.advance(8000)
        runs.append(simulation.run())
    assert runs[1].position == pytest.approx(runs[0].position, abs=2e-3 * SIZE)
    assert runs[1].voltage[3990] - runs[0].voltage[3990] == pytest.approx(0.0, abs=1e-3 * PUSH)


def test_members_of_ensembles_are_runs() -> None:
    sizes, screw = np.array([SIZE, -SIZE, 0.1 * SIZE]), 0.5 * GAP
    laws = np.array([PD, FED, FED.replace(feedforward=0.01, velocity_feedforward=100.0)])[:, None]
    cases = Cases(sizes, GAP, 0.0, screw, 0.005, FRICTION)
    continuous = simulate_members(PAPER, laws, 2.0, cases, outputs=("position",), sample_rate=100.0)["position"]
    fast = np.array([[law.replace(sample_rate=1000.0)] for law in laws[:, 0]])
    ramp = PiecewiseCubic([0.0, 0.7], [[0.0, 1.0, 0.0, 0.0], [0.7, 0.0, 0.0, 0.0]])
    for shape in (1.0, ramp):
        sampled = simulate_sampled(PAPER, fast, 2.0, SampledCases(*cases), ("position",), 100.0, shape=shape)[
            "position"
        ]
        for i, j in np.ndindex(3, 3):
            reference = as_pieces(shape, 2.0).scaled(float(sizes[j]))
            options = {"gap": GAP, "theta_d0": screw, "input_bias": 0.005, "friction": FRICTION, "sample_rate": 100.0}
            one = simulate(PAPER, 2.0, controller=fast[i, 0], reference=reference, **options)
            assert sampled[i, j] == pytest.approx(one.position, abs=1e-8 * SIZE)
            if shape == 1.0:
                one = simulate(PAPER, 2.0, controller=laws[i, 0], reference=reference, **options)
                assert continuous[i, j] == pytest.approx(one.position, abs=1e-8 * SIZE)


def test_moves_to_and_fro_are_those_of_a_square_wave() -> None:
    cases = Cases(SIZE, GAP, 0.0, 0.0, 0.005, FRICTION)
    error = errors_to_and_fro(PAPER, FED, 2.0, cases, 3, 200.0)
    times = 2.0 * np.arange(4)
    reference = PiecewiseCubic.zero_order_hold(times, SIZE * np.array([1.0, 0.0, 1.0, 0.0]))
    exact = simulate(
        PAPER, 8.0, controller=FED, reference=reference, gap=GAP, input_bias=0.005, friction=FRICTION, sample_rate=200.0
    )
    size = np.abs(exact.reference - exact.position)[400:1600]
    assert float(error) == pytest.approx(float(size.mean()), rel=1e-2)


def test_ticks_in_blocks_with_noise_keep_the_direction() -> None:
    """A long run, whose plant advances in blocks, is the run tick by tick."""
    law, noise = FED.replace(sample_rate=1000.0), Noise(std=1e-6, kind="white")
    options = {
        "controller": law,
        "reference": SquareWave(SIZE, PERIOD),
        "gap": GAP,
        "friction": FRICTION,
        "noise": noise,
    }
    whole = simulate(PAPER, 24.0, sample_rate=1000.0, **options)
    simulation = Simulation(PAPER, 24.0, sample_rate=1000.0, **options)
    simulation.advance(24_000)
    assert whole.position == pytest.approx(simulation.run().position, abs=1e-9 * SIZE)
