"""Input bias and noise from the rest in a window: simulated loops, windows made by hand, and refusals."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from servotwin.estimation.disturbance import SHORTEST, Disturbance, disturbance, quick_bias
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import Run, simulate

PAPER = Servo.preset("paper")
CALM = PAPER.replace(Ki=0.0)
RATE = 5000.0


@cache
def loop(servo: Servo, bias: float, gap_deg: float, noise: Noise | None = None) -> Run:
    wave = SquareWave(1e-3, 20.0)
    return simulate(servo, 32.0, reference=wave, gap=math.radians(gap_deg), input_bias=bias, noise=noise, seed=3)


def seen(run: Run, start: float = 29.7, duration: float = 2.0) -> Disturbance:
    return disturbance(Window.from_run(run, start, duration), CALM)


@pytest.mark.parametrize("bias", [-0.1, 0.0, 0.03])
@pytest.mark.parametrize("gap_deg", [4.0, 15.0])
def test_a_calm_loop_shows_its_bias_before_the_step(bias, gap_deg):
    """Also where the motor still creeps across its gap (15 deg): the back EMF is taken off."""
    found = seen(loop(CALM, bias, gap_deg))
    assert found.bias == pytest.approx(bias, abs=1e-5)
    assert abs(found.bias - bias) < 3.0 * found.bias_std < 3e-3
    assert found.rest == pytest.approx(0.3, abs=0.03)
    assert found.noise < 2e-8
    assert found.reasons == ()


def test_with_feedforward_the_total_voltage_counts():
    plain, helped = (
        simulate(CALM, 12.0, controller=CALM.controller.replace(feedforward=f), reference=1e-3, input_bias=0.08)
        for f in (0.0, -0.08)
    )
    for run in (plain, helped):
        assert disturbance(Window.from_run(run, 10.0, 1.5), CALM).bias == pytest.approx(0.08, abs=1e-5)
    assert abs(np.mean(helped.reference[-100:] - helped.position[-100:])) < 1e-7
    assert abs(np.mean(plain.reference[-100:] - plain.position[-100:])) > 1e-5


@pytest.mark.slow
def test_in_the_papers_noise():
    found = seen(loop(CALM, 0.1, 4.0, Noise(std=0.22e-3, band=(10.0, 50.0))))
    assert abs(found.bias - 0.1) < 3.0 * found.bias_std < 6e-3
    assert found.noise == pytest.approx(0.22e-3, rel=0.15)


@pytest.mark.slow
def test_white_noise_is_measured_beside_a_slow_drift():
    found = seen(loop(CALM, 0.0, 4.0, Noise(std=2e-6)))
    assert found.noise == pytest.approx(2e-6, rel=0.05)


def test_a_limit_cycle_is_no_rest():
    found = seen(loop(PAPER, 0.05, 10.0))
    voltage = Window.from_run(loop(PAPER, 0.05, 10.0), 29.7, 2.0).voltage
    assert math.isnan(found.bias)
    assert math.isnan(found.noise)
    assert math.isinf(found.bias_std)
    assert not found.known
    assert found.rest == 0.0
    assert "rest nowhere for 0.1 s" in found.reasons[0]
    assert found.effort == pytest.approx(np.sqrt(np.mean(voltage**2)))


def by_hand(voltage, position=None, theta_m=None, reference=None) -> Window:
    still = np.zeros(voltage.size)
    given = (position, theta_m, voltage, reference)
    return Window(*(still if value is None else value for value in given), sample_rate=RATE)


def test_of_a_command_beyond_the_drive_s_limit_the_drive_s_part_counts():
    """A motor that an input bias holds against all that its drive gives."""
    axis = Axis.preset("ball-screw")
    axis = axis.replace(actuator=dataclasses.replace(axis.actuator, limit=3.0))
    window = by_hand(np.full(5000, 8.0))
    assert disturbance(window, axis).bias == quick_bias(window, axis)[0] == -3.0


def coloured(rng: np.random.Generator, memory: float, size: int) -> np.ndarray:
    return math.sqrt(1.0 - memory**2) * lfilter([1.0], [1.0, -memory], rng.standard_normal(size + 2000))[2000:]


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "size"), [(0.0, 2500), (0.0, 500), (0.95, 2500), (0.99, 5000)])
def test_the_spread_holds_what_it_says(memory, size):
    """Voltage noise of 1 V, white or with a memory of up to 20 ms, and a bias of 0.2 V."""
    rng, inside, errors = np.random.default_rng(1), [], []
    for _ in range(150):
        found = disturbance(by_hand(coloured(rng, memory, size) - 0.2), CALM)
        inside.append(abs(found.bias - 0.2) < 1.96 * found.bias_std)
        errors.append(found.bias - 0.2)
    true = math.sqrt((1.0 + memory) / (1.0 - memory) / size)
    assert np.mean(inside) > 0.88
    assert np.std(errors) < 2.5 * true


def test_a_creeping_motor_is_corrected_and_less_sure():
    """0.5 rad/s: 50 mV of back EMF, of which a tenth is doubted."""
    time = np.arange(2000) / RATE
    found = disturbance(by_hand(np.full(2000, 0.12), theta_m=0.5 * time), CALM)
    assert found.bias == pytest.approx(CALM.k_B * 0.5 - 0.12, abs=1e-9)
    assert found.bias_std == pytest.approx(0.1 * CALM.k_B * 0.5, rel=0.1)


def test_a_drifting_voltage_is_less_sure():
    found = disturbance(by_hand(-0.1 + 0.02 * np.linspace(-1.0, 1.0, 500)), CALM)
    assert abs(found.bias - 0.1) < found.bias_std
    assert found.bias_std > 5e-3


def test_only_a_constant_reference_counts():
    """The step is at 0.06 s: what is before is too short, what is after is not."""
    step = np.where(np.arange(1500) < 300, 0.0, 1e-3)
    voltage = np.where(np.arange(1500) < 300, 5.0, -0.3)
    assert disturbance(by_hand(voltage, reference=step), CALM).bias == pytest.approx(0.3)
    ramp = disturbance(by_hand(voltage, reference=np.arange(1500) * 1e-6), CALM)
    assert "nowhere constant for 0.1 s" in ramp.reasons[0]
    short = disturbance(by_hand(np.full(round(SHORTEST * RATE) - 1, -0.3)), CALM)
    assert math.isnan(short.bias)
    assert disturbance(by_hand(np.full(round(SHORTEST * RATE), -0.3)), CALM).rest == pytest.approx(SHORTEST)


def test_a_swing_is_not_taken_for_noise():
    """3 Hz of 0.3 mm under 0.05 mm of noise: the motor goes with it."""
    rng, time = np.random.default_rng(2), np.arange(5000) / RATE
    swing = 3e-4 * np.sin(2.0 * np.pi * 3.0 * time)
    moving = swing + 5e-5 * rng.standard_normal(5000)
    found = disturbance(by_hand(np.sin(time), position=moving, theta_m=swing / CALM.p), CALM)
    assert not found.known


@pytest.mark.parametrize("name", ["voltage", "theta_m", "reference"])
def test_a_missing_channel_is_named(name):
    channels = {key: np.zeros(1000) for key in ("position", "voltage", "theta_m", "reference") if key != name}
    found = disturbance(Window(**channels, sample_rate=RATE), CALM)
    assert f"no {name}" in found.reasons[0]
    assert math.isnan(found.effort) == (name == "voltage")


@pytest.mark.parametrize("rate", [20.0, 1000.0, 44_100.0])
def test_any_sample_rate(rate):
    still = np.zeros(max(16, round(0.7 * rate)))
    found = disturbance(Window(still, still, still - 0.1, still, sample_rate=rate), CALM)
    assert found.bias == pytest.approx(0.1)
