"""Windows with few samples of a swing: the motor's motion between two samples, and what is refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from servotwin.commissioning.edge_settings import Commissioning, Recording
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.output_error import least_rate
from servotwin.estimation.output_error.models import gains
from servotwin.estimation.output_error.shaft import between
from servotwin.estimation.window import Window
from servotwin.plant.actuator import DcMotor, TorqueDrive
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import Array, SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate
from servotwin.twin.settings import TwinSettings

DEG = math.pi / 180.0
# A motor that its load throws back at 18.8 Hz.
DRIVE = Axis(
    TorqueDrive(1e-4, friction=1e-3),
    Transmission(0.01, 1e4, 30.0, "free"),
    Load((2.5,), (0.0,), (10.0,)),
    Controller(Kp=0.5, Ki=0.0, Kd=0.05, Tf=0.02, sample_rate=100.0),
    Sensors(1e-5, 1e-7),
)


def test_a_motion_between_samples_is_a_cubic_that_follows_parabolas_exactly() -> None:
    time = np.arange(8.0)
    parabola = 0.3 * time**2 - time + 2.0
    for i in range(1, 6):
        for share in (0.0, 0.25, 0.5, 1.0):
            at = i + share
            assert between(parabola, i, share) == pytest.approx(0.3 * at**2 - at + 2.0, abs=1e-13)
    line = 0.5 * time - 1.0
    assert [between(line, i, 0.75) for i in (0, 6)] == pytest.approx([0.5 * 0.75 - 1.0, 0.5 * 6.75 - 1.0])
    # Of a swing with six samples a period a cubic misses a fifth of what a straight line does.
    swing = np.sin(2.0 * math.pi * np.arange(60) / 6.0 + 0.4)
    true = np.sin(2.0 * math.pi * (np.arange(1, 58) + 0.5) / 6.0 + 0.4)
    cubic = np.array([between(swing, i, 0.5) for i in range(1, 58)])
    straight = 0.5 * (swing[1:58] + swing[2:59])
    assert np.abs(cubic - true).max() < 0.21 * np.abs(straight - true).max()


def test_the_swing_of_motor_and_load_sets_the_least_rate() -> None:
    stiffness = DRIVE.transmission.k_d * (DRIVE.p**2 / 1e-4 + 1.0 / 2.5)
    assert least_rate(DRIVE) == pytest.approx(7.0 * math.sqrt(stiffness) / (2.0 * math.pi))
    two = DRIVE.replace(load=Load((1.5, 1.0), (0.0, 5000.0), (10.0, 1.0)))
    assert least_rate(two) == pytest.approx(least_rate(DRIVE))
    assert least_rate(DRIVE.replace(actuator=DcMotor(1e-4, 1.0, 0.1, 0.1))) == pytest.approx(least_rate(DRIVE))
    for name in AXES:
        axis = Axis.preset(name)
        assert (axis.controller.sample_rate or 0.0) > least_rate(axis)
    assert least_rate(Axis.preset("telescope")) == 0.0


def _window(axis: Axis, rate: float, gap: float) -> Window:
    law = DRIVE.pidf.replace(sample_rate=rate)
    run = simulate(axis, 24.0, controller=law, reference=SquareWave(0.02, 12.0), gap=gap, sample_rate=rate)
    return Window.from_run(run, 5.5, 8.0)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [140.0, 200.0])
def test_windows_with_few_samples_of_a_swing_have_the_gap_in_their_intervals(rate: float) -> None:
    """Straight lines between samples made one of these gaps wrong by 1.6 %, and the interval 1 % wide."""
    random = np.random.default_rng(3)
    for gap in (6.0 * DEG, 12.0 * DEG):
        errors = 1.0 + random.uniform(-1, 1, 4) * (0.05, 0.3, 0.1, 0.1)
        factors = dict(zip(("k", "c", "k_T", "k_B"), errors.tolist(), strict=True))
        found = estimate_gap(_window(DRIVE.scaled(factors), rate, gap), DRIVE)
        assert found.interval[0] <= gap <= found.interval[1]
        assert found.ok
        assert found.gap == pytest.approx(gap, rel=0.01)


def test_too_few_samples_of_a_swing_are_refused_with_the_rate_that_is_needed() -> None:
    window = _window(DRIVE, 100.0, 6.0 * DEG)
    found = estimate_gap(window, DRIVE)
    assert found.status is GapStatus.UNIDENTIFIABLE
    words = r"100 Hz are too few samples: motor and load swing .* at 18\.\d+ Hz, and 7 samples a period, 131\.\d+ Hz"
    assert re.match(words, found.reasons[0])
    law = DRIVE.pidf.replace(sample_rate=100.0)
    twin, recording = TwinSettings(policy="paper", k_dz=0.0), Recording(sample_rate=100.0, window=10.0)
    with pytest.raises(InvalidInput, match="recording sample_rate_hz: 100 Hz are too few samples"):
        Commissioning(DRIVE, law, twin, recording).check_window()
    # The estimator of the motor's side simulates the motor itself.
    semi = DRIVE.replace(sensors=replace(DRIVE.sensors, feedback="motor"))
    Commissioning(semi, law, twin, recording).check_window()


@pytest.mark.slow
def test_a_motor_that_turns_sharply_between_samples_is_refused() -> None:
    """Of a gap that is small beside what the samples leave open of the motor's place."""
    law = DRIVE.pidf.replace(Kp=2.0, Kd=0.3, Tf=0.005, sample_rate=150.0)
    run = simulate(DRIVE, 12.0, controller=law, reference=SquareWave(0.2, 1.0), gap=0.5 * DEG, sample_rate=150.0)
    found = estimate_gap(Window.from_run(run, 1.0, 8.0), DRIVE)
    assert not found.ok
    assert any("a higher sample rate is needed" in each for each in found.reasons)


def test_a_position_that_is_the_motors_own_is_refused_in_a_sentence() -> None:
    time = np.arange(2000) / 200.0
    motor = np.sin(2.0 * math.pi * time)
    for axis in (DRIVE, Axis.preset("stepper-stage")):
        window = Window(theta_m=motor, position=axis.p * motor, voltage=0.0 * motor, sample_rate=200.0)
        found = estimate_gap(window, axis)
        assert found.status is GapStatus.UNIDENTIFIABLE
        assert "not the load's own" in found.reasons[0]


@pytest.mark.parametrize("turn", [0.01, 0.3, 1.0, 4.0])
def test_the_errors_of_the_observer_fade_at_its_rate_however_few_the_samples(turn: float) -> None:
    """Gains of continuous time make it unstable from two thirds of a radian of the shaft's own frequency a sample."""
    interval = 0.02
    places, speeds = gains(turn / interval, interval)
    moved = np.array([[1.0, interval], [0.0, 1.0]]) @ np.array([[1.0 - places, 0.0], [-speeds, 1.0]])
    assert np.trace(moved) == pytest.approx(2.0 * math.exp(-turn), rel=1e-12)
    assert np.linalg.det(moved) == pytest.approx(math.exp(-2.0 * turn), rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_a_count_of_the_motors_encoder_does_not_widen_the_gap(seed: int) -> None:
    """Play follows the extremes of a noisy angle: with a low-pass alone the gap is a count too wide, and outside."""
    axis, random = Axis.preset("micro-positioner"), np.random.default_rng(seed)
    fine = axis.replace(sensors=replace(axis.sensors, encoder_resolution=0.0, position_resolution=0.0))
    gap = 6e-7 / axis.p
    run = simulate(fine, 9.0, reference=SquareWave(1.2e-5, 6.0), gap=gap, sample_rate=5000.0)
    window = Window.from_run(run, 2.85, 4.8)

    def read(signal: Array, count: float) -> Array:
        return np.asarray(count * np.round(signal / count + random.normal(size=signal.size)))

    assert window.theta_m is not None
    noisy = window.replace(
        theta_m=read(window.theta_m, axis.sensors.encoder_resolution),
        position=read(window.position, axis.sensors.position_resolution),
    )
    found = estimate_gap(noisy, axis)
    assert found.ok, found.reasons
    assert found.interval[0] <= gap <= found.interval[1]
    assert abs(found.gap - gap) < axis.sensors.encoder_resolution
