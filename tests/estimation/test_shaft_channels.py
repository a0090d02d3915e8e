"""Windows of free shafts whose channels are not what they should be: refused by name."""

import math
from functools import cache

import numpy as np
import pytest

from benchmarks.axis_faults import faulty_windows
from benchmarks.random_axes import random_axis, step_window
from servotwin.estimation.core.visible import counted
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.whitened.channels import faults, other_units
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.load import ROTARY

SCREW = Axis.preset("ball-screw")


@cache
def screw(kind: str = "none") -> tuple[float, Window]:
    """Total gap (rad) and a window of a ball screw with a kind of fault."""
    machine, gap, window = next(faulty_windows("ball-screw", kind, 1, 5))
    assert machine.model == SCREW
    return gap, window


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("position held", "position repeats one value in full motion"),
        ("angle held", "theta_m repeats one value in full motion"),
        ("position stuck", "position stays at its extreme"),
        ("angle stuck", "theta_m stays at its extreme"),
        ("angle spiked", "theta_m leaves its neighbours by"),
        ("position doubled", "the pitch seems to be 2 times the model's"),
        ("position halved", "the pitch seems to be 0.5 times the model's"),
        ("position in mm or degrees", "position seems to be in mm, not in m"),
        ("angle reversed", "position or theta_m seems to have the wrong sign"),
    ],
)
def test_a_wrong_channel_of_a_free_shaft_is_refused_by_name(kind: str, words: str) -> None:
    estimate = estimate_gap(screw(kind)[1], SCREW)
    assert estimate.status is GapStatus.MODEL_MISMATCH
    assert words in estimate.reasons[0]


def test_a_rotary_position_is_named_in_its_own_units() -> None:
    _, window = screw()
    spiked = window.position.copy()
    spiked[350] += 0.1 * np.ptp(spiked)
    (sentence,) = faults(window.replace(position=spiked), ROTARY)
    assert " deg in sample 350 alone" in sentence


def test_a_light_motor_that_its_load_throws_back_within_few_samples_is_no_spike() -> None:
    drawn = random_axis("torque", 777, 32)
    for step in (1, 2, 3):
        assert faults(step_window(drawn, step), drawn.model.load.motion) == ()


def test_an_even_swing_whose_crests_are_at_one_count_is_not_saturated() -> None:
    swing = np.round(60.0 * np.sin(0.2 * math.pi * np.arange(4000) / 4.0))
    assert np.sum(swing == swing.max()) > 20
    assert faults(Window(1e-6 * swing, 1e-3 * swing, sample_rate=1000.0)) == ()


def test_a_motor_that_friction_stops_is_not_saturated_and_one_whose_channel_is_cut_is() -> None:
    """It slows down by as much in each sample, here from 27 counts a sample by 0.55."""
    left = 2000.0 - np.arange(4000.0)  # samples to the stop
    braking = 27.0 / 0.55
    way = np.where(left > braking, 27.0 * (left - 0.5 * braking), 0.5 * 0.55 * left.clip(0.0) ** 2)
    counts = np.round(way + 0.4)
    assert faults(Window(1e-6 * counts, 1e-3 * counts, sample_rate=1000.0)) == ()
    cut = np.maximum(counts, 60.0)
    sentences = faults(Window(1e-6 * cut, 1e-3 * cut, sample_rate=1000.0))
    assert all("stays at its extreme" in sentence for sentence in sentences)
    assert len(sentences) == 2


def test_a_load_that_friction_stops_within_few_samples_is_not_saturated() -> None:
    """Seen on a ball screw: the load brakes once its motor no longer pushes it, by 25 counts in each sample."""
    steps = np.concatenate([np.full(400, 92.0), [85.0, 77.0, 73.0, 61.0, 36.0, 11.0], np.zeros(200)])
    counts = np.cumsum(np.concatenate([steps, -steps]))
    assert faults(Window(1e-7 * counts, 1e-3 * counts, sample_rate=2000.0)) == ()
    cut = np.minimum(counts, counts.max() - 150.0)
    assert any("stays at its extreme" in each for each in faults(Window(1e-7 * cut, 1e-3 * counts, sample_rate=2000.0)))


def test_a_load_that_creeps_behind_its_motor_before_it_stops_is_not_saturated() -> None:
    """Seen on two ball screws: the load brakes to the speed of its motor, and stops within three samples of it."""
    creeping = [27.0, 24.0, 20.0, 12.0, 8.0, 7.0, 7.0, 7.0, 8.0, 8.0, 6.0, 2.0]
    steps = np.concatenate([np.full(400, 92.0), np.linspace(90.0, 30.0, 20), creeping, np.zeros(200)])
    counts = np.cumsum(np.concatenate([steps, -steps]))
    assert faults(Window(1e-7 * counts, 1e-3 * counts, sample_rate=2000.0)) == ()
    for lost in (300.0, 1500.0):
        cut = np.minimum(counts, counts.max() - lost)
        told = faults(Window(1e-7 * cut, 1e-3 * counts, sample_rate=2000.0))
        assert any("stays at its extreme" in each for each in told)


def test_a_load_that_breaks_loose_by_a_count_has_not_slipped_where_samples_were_rounded_again() -> None:
    """A message's 16 bits lie beside the grid of an encoder of 17."""
    count = 2.0 * math.pi / 2**17
    counts = np.concatenate([np.repeat(np.arange(0.0, 60.0), 30), np.full(300, 60.0), np.full(300, 61.0)])
    position = np.round(count * counts / 7e-7) * 7e-7
    assert counted(position) == pytest.approx(count, rel=5e-3)
    motor = np.concatenate([np.sin(np.linspace(0.0, 0.5 * math.pi, 1800)), np.ones(600)])
    assert faults(Window(position, motor, sample_rate=1000.0), ROTARY) == ()


def test_noise_that_moves_one_sample_by_two_counts_is_no_fault() -> None:
    """In a motor's counts, whose differences are whole numbers of them but for the last digits."""
    counts = np.round(np.linspace(0.0, 100.0, 3000))
    counts[1501] += 2.0
    angle = 2.0 * math.pi / 4096.0 * counts
    position = np.linspace(0.0, 1e-2, 3000)
    assert faults(Window(position, angle, sample_rate=2000.0)) == ()
    angle[1501] += 2.0 * math.pi / 4096.0
    assert any("theta_m leaves its neighbours" in each for each in faults(Window(position, angle, sample_rate=2000.0)))


def test_noise_of_few_counts_that_repeats_by_chance_was_not_held() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        noisy = np.round(rng.normal(0.0, 2.0, (2, 2000)) + 20.0 * np.sin(np.arange(2000) / 300.0))
        assert faults(Window(*noisy, sample_rate=1000.0)) == ()


@pytest.mark.parametrize(("angle", "position"), [(57.2958, 57.2958), (57.2958, 1e3), (1.0 / math.tau, 1e3)])
def test_channels_that_are_both_in_other_units_are_told_by_their_counts(angle: float, position: float) -> None:
    """A ball screw moves alike at any scale: in degrees both its gap was 57 times too wide, and accepted."""
    _, window = screw()
    assert window.theta_m is not None
    angle_count, position_count = SCREW.encoder_resolution, SCREW.sensors.position_resolution
    assert other_units(window, angle_count, position_count) == ()
    other = window.replace(theta_m=angle * window.theta_m, position=position * window.position)
    made = estimate_gap(other, SCREW)
    assert made.status is GapStatus.MODEL_MISMATCH
    assert "both seem to be in other units" in made.reasons[0]
    # One channel alone may come in steps of the log.
    assert other_units(window.replace(position=position * window.position), angle_count, position_count) == ()


@pytest.mark.parametrize("seed", [48, 139, 168, 239])
def test_counts_that_repeat_by_chance_at_rest_were_not_held(seed: int) -> None:
    """Noise of 1.5 counts, before a move from 2 s on and after it: of 100 such windows three were refused."""
    random, time = np.random.default_rng(seed), np.arange(24000) / 5000.0
    way = 8000.0 * (1.0 - np.exp(-6.0 * np.clip(time - 2.0, 0.0, None)))
    position = np.round(way + random.normal(0.0, 1.5, time.size))
    assert faults(Window(position, way, sample_rate=5000.0)) == ()
