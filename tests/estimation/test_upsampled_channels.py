"""Angles that were measured more slowly than recorded, told from counts, slow motion and held commands."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.axis_faults import faulty_windows
from benchmarks.preset_machines import preset_machines
from servotwin.estimation.core.upsampling import held_factor, line_factor
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import Simulation, simulate

SERVO = Servo.preset("paper")
PRESETS = ("ball-screw", "robot-joint", "telescope", "gantry", "stepper-stage", "micro-positioner", "two-mass-drive")


def held(values, every, first=0):
    """Each n-th sample, repeated until the next one."""
    place = (np.arange(values.size) - first) // every * every + first
    return values[np.clip(place, 0, None)]


def lines(values, every, first=0):
    """Each n-th sample, with lines between them."""
    knots = np.arange(first, values.size, every)
    return np.interp(np.arange(values.size), knots, values[knots])


@cache
def calm_window():
    """A step of the paper's servo without integral action, whose motor pushes one flank only."""
    law = SERVO.controller.replace(Ki=0.0, Kp=0.6 * SERVO.controller.Kp, Kd=0.6 * SERVO.controller.Kd)
    run = simulate(SERVO, 20.0, controller=law, reference=SquareWave(1e-3, 30.0), gap=math.radians(10.0))
    window = Window.from_run(run, 14.7, 2.0)
    return window.replace(position=window.position + np.random.default_rng(1).normal(0.0, 1e-6, window.position.size))


@cache
def preset_window(name):
    """A window of a preset, both channels in counts."""
    machine, gap, window = next(faulty_windows(name, "none", 1, 7))
    return machine.model, gap, window


@pytest.mark.parametrize(("slow", "how"), [(held, "held"), (lines, "interpolated")])
def test_a_slow_angle_of_a_servo_is_named_and_bounds_no_gap(slow, how):
    window = calm_window()
    made = estimate_gap(window.replace(theta_m=slow(window.theta_m, 8, 3)), SERVO)
    assert made.status is GapStatus.MODEL_MISMATCH
    (sentence,) = made.reasons
    assert sentence.startswith(f"theta_m is {how} from a rate about 8 times slower")
    assert "give the window at 625 Hz" in sentence


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("every", [2, 5, 20])
def test_slow_channels_of_presets_are_named_and_those_as_they_should_be_are_not(name, every):
    _, _, window = preset_window(name)
    for values in (window.position, window.theta_m):
        assert (held_factor(values), line_factor(values)) == (0, 0)
        assert held_factor(held(values, every, 1)) == every
        assert line_factor(lines(values, every, 1)) == every


@pytest.mark.parametrize("name", ["stepper-stage", "telescope", "robot-joint"])
def test_a_command_that_is_held_between_ticks_is_no_slow_channel(name):
    """The encoders are read twenty times within a tick of the law: of a stepper's motor each tick is a kink."""
    machine = replace(preset_machines(name, 1, 3)[0], worn=(2.0, 2.0), steps=2)
    rate = 20 * machine.rate
    simulation = Simulation(
        machine.plant, machine.duration, reference=machine.reference, gap=machine.gap, sample_rate=rate
    )
    simulation.advance(simulation.samples - 1)
    run = simulation.run()
    part = slice(round(0.45 * run.time.size), round(0.7 * run.time.size))
    for values, count in (
        (run.theta_m[part], machine.model.encoder_resolution),
        (run.position[part], machine.model.sensors.position_resolution),
    ):
        for shown in (values, count * np.round(values / count)):
            assert (held_factor(shown), line_factor(shown)) == (0, 0)


def test_an_even_motion_of_one_count_in_every_eighth_sample_was_not_held():
    counts = np.concatenate([np.zeros(400), np.arange(3200) // 8, np.full(400, 399.0)])
    assert (held_factor(1e-3 * counts), line_factor(1e-3 * counts)) == (0, 0)


@pytest.mark.parametrize("size", [3.0, 20.0, 60.0])
@pytest.mark.parametrize("period", [24, 40, 60, 200])
def test_an_even_swing_of_a_whole_number_of_samples_was_not_held(size, period):
    for turn in np.linspace(0.0, 1.0, 7):
        counts = np.round(size * np.sin(2.0 * np.pi * np.arange(4000) / period + turn))
        assert (held_factor(counts), line_factor(counts)) == (0, 0)


def test_a_slow_motion_is_told_by_changes_that_fall_on_every_eighth_sample():
    swing = 30.0 * np.sin(np.arange(8000) / 900.0)
    assert held_factor(np.round(swing)) == 0
    assert held_factor(np.round(held(swing, 8, 5))) == 8


@pytest.mark.parametrize("noise", [0.3, 1.0, 3.0])
def test_noise_of_counts_is_neither_held_nor_interpolated_and_shows_where_it_was(noise):
    rng = np.random.default_rng(2)
    for _ in range(10):
        noisy = np.round(rng.normal(0.0, noise, 4000) + 50.0 * np.sin(np.arange(4000) / 300.0))
        assert (held_factor(noisy), line_factor(noisy)) == (0, 0)
        assert held_factor(held(noisy, 4)) == 4
        assert line_factor(np.round(lines(noisy, 4), 6)) == 4


def test_a_slow_channel_that_is_not_in_step_with_the_window_is_told_where_it_is_held():
    motion = np.sin(np.arange(4000) / 300.0)
    assert held_factor(motion[(np.arange(4000) / 7.7).astype(int) * 7]) in (7, 8)


def test_a_position_that_a_slower_law_read_is_late_as_others_are():
    """The paper's servo moves little within a tick."""
    window = calm_window()
    made = estimate_gap(window.replace(position=held(window.position, 5)), SERVO)
    assert not any("slower" in reason for reason in made.reasons)


@pytest.mark.slow
def test_a_stepper_counts_as_it_may():
    """Its counter changes with its command."""
    axis, gap, window = preset_window("stepper-stage")
    counter = estimate_gap(window.replace(theta_m=held(window.theta_m, 8)), axis)
    assert not any("slower" in reason for reason in counter.reasons)
    assert not counter.ok or counter.interval[0] <= gap <= counter.interval[1]


def test_a_motor_without_an_encoder_at_the_load_is_told_too():
    light = Axis.preset("ball-screw")
    axis = light.replace(load=replace(light.load, m=(100.0,)))
    _, _, window = preset_window("ball-screw")
    theta_m = held(window.theta_m, 4)
    made = estimate_gap(Window(theta_m=theta_m, voltage=np.sin(theta_m), sample_rate=window.sample_rate), axis)
    assert made.status is GapStatus.MODEL_MISMATCH
    assert "theta_m is held from a rate about 4 times slower" in made.reasons[0]
