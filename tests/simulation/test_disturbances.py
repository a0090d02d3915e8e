"""What disturbs the plant at its input, and the feedforward that cancels it: closed forms and an oracle by expm."""

import math

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from servotwin.errors import InvalidInput
from servotwin.plant import loop
from servotwin.plant.automaton import Shape, continuous_loop
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import simulate

PAPER = Servo.preset("paper")
CALM = PAPER.controller.replace(Ki=0.0)
RATES = [None, 1000.0]


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("bias", [0.05, -0.1])
def test_without_integral_action_the_bias_leaves_an_error(rate: float | None, bias: float) -> None:
    """At rest the voltages cancel, u + bias = 0, and u = Kp e."""
    run = simulate(PAPER, 40.0, controller=CALM.replace(sample_rate=rate), reference=1e-3, input_bias=bias)
    assert run.voltage[-1] == pytest.approx(-bias, rel=1e-9)
    assert run.reference[-1] - run.position[-1] == pytest.approx(-bias / CALM.Kp, rel=1e-9)


@pytest.mark.parametrize("rate", RATES)
def test_integral_action_removes_the_error(rate: float | None) -> None:
    law = CALM.replace(Ki=200.0, sample_rate=rate)
    run = simulate(PAPER, 200.0, controller=law, reference=1e-3, input_bias=0.05, sample_rate=100.0)
    assert run.reference[-1] - run.position[-1] == pytest.approx(0.0, abs=1e-12)
    assert run.voltage[-1] == pytest.approx(-0.05, rel=1e-9)


def test_the_linear_loop_agrees_with_expm() -> None:
    """Plant and PIDF as one matrix, made from the transfer functions' state spaces and not from the automaton."""
    law, bias, reference, feedforward = PAPER.controller, 0.03, 1e-3, 0.02
    plant, pidf = PAPER.plant(), loop.pidf(law)
    size, own = plant.B.size, pidf.B.size
    A, B = np.zeros((size + own, size + own)), np.zeros(size + own)
    A[:size, :size] = plant.A - np.outer(plant.B, pidf.D * plant.C)
    A[:size, size:] = np.outer(plant.B, pidf.C)
    A[size:, :size] = -np.outer(pidf.B, plant.C)
    A[size:, size:] = pidf.A
    B[:size] = plant.B * (pidf.D * reference + bias + feedforward)
    B[size:] = pidf.B * reference
    step = expm(np.block([[A, B[:, None]], [np.zeros((1, size + own + 1))]]) * 0.01)
    state, position, voltage = np.append(np.zeros(size + own), 1.0), [], []
    for _ in range(501):
        position.append(plant.C @ state[:size])
        error = reference - position[-1]
        voltage.append(pidf.C @ state[size:-1] + pidf.D * error + feedforward)
        state = step @ state
    run = simulate(
        PAPER,
        5.0,
        controller=law.replace(feedforward=feedforward),
        reference=reference,
        input_bias=bias,
        sample_rate=100.0,
    )
    assert np.abs(run.position - position).max() < 1e-10 * np.abs(position).max()
    assert np.abs(run.voltage - voltage).max() < 1e-10 * np.abs(voltage).max()


@examples(15)
@given(
    bias=st.floats(-0.2, 0.2),
    degrees=st.floats(0.0, 15.0),
    zone=st.booleans(),
    rate=st.sampled_from(RATES),
    ki=st.sampled_from([0.0, 200.0]),
)
def test_the_feedforward_cancels_the_bias(
    bias: float, degrees: float, zone: bool, rate: float | None, ki: float
) -> None:
    """Inside the dead zone too; only the voltage that is reported differs."""
    law = CALM.replace(Ki=ki, sample_rate=rate)
    gap = math.radians(degrees)
    options = {
        "reference": SquareWave(1e-3, 4.0),
        "gap": SCurve(0.0, gap, 4.0),
        "tolerance": PAPER.tolerance_for(gap) if zone else None,
        "sample_rate": 1000.0,
    }
    clean = simulate(PAPER, 4.0, controller=law, **options)
    cancelled = simulate(PAPER, 4.0, controller=law.replace(feedforward=-bias), input_bias=bias, **options)
    assert np.abs(cancelled.position - clean.position).max() < 1e-11
    assert np.abs(cancelled.voltage + bias - clean.voltage).max() < 1e-7


@pytest.mark.parametrize("rate", RATES)
def test_the_limit_holds_inside_the_dead_zone_too(rate: float | None) -> None:
    """The bias is behind the limit: what cannot be cancelled moves the motor at its no-load speed."""
    law = CALM.replace(feedforward=0.3, voltage_limit=0.2, sample_rate=rate)
    run = simulate(PAPER, 0.05, controller=law, tolerance=1.0, input_bias=0.1, sample_rate=1000.0)
    assert np.all(run.voltage == 0.2)
    late = simulate(PAPER, 20.0, controller=law, tolerance=1.0, input_bias=0.1, sample_rate=1000.0)
    speed = (late.theta_m[-1] - late.theta_m[-1001]) / 1.0
    assert speed == pytest.approx(0.3 / PAPER.k_B, rel=1e-9)


def test_an_absent_disturbance_costs_nothing() -> None:
    plain = continuous_loop(PAPER, PAPER.controller, Shape())
    assert not {"input bias", "friction", "feedforward", "offset"} & set(plain.automaton.names)
    assert len(plain.automaton.modes) == 9
    both = continuous_loop(PAPER, PAPER.controller, Shape(bias=True, feedforward=True))
    assert {"input bias", "feedforward"} <= set(both.automaton.names)
    assert len(both.automaton.names) == len(plain.automaton.names)


def test_one_automaton_for_every_feedforward() -> None:
    shape = Shape(feedforward=True)
    assert continuous_loop(PAPER, CALM.replace(feedforward=0.1), shape) is continuous_loop(PAPER, CALM, shape)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"input_bias": math.nan}, "input_bias = nan V"),
        ({"friction": -1e-3}, r"friction = -0\.001 N m"),
        ({"friction": math.inf}, "friction = inf N m"),
    ],
)
def test_what_cannot_be_is_refused(options: dict[str, object], text: str) -> None:
    with pytest.raises(InvalidInput, match=text):
        simulate(**({"servo": PAPER, "duration": 1.0} | options))
