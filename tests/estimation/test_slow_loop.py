"""A model whose stated loop is far slower than its structure: the window shows the gap all the same."""

import math

import numpy as np
import pytest

from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.scales import scales, structure_time
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.simulation import simulate

PAPER, GAP = Servo.preset("paper"), math.radians(10.0)


def stated_slower(times: float) -> Servo:
    """The paper's servo, whose stated loop is so many times slower than its own."""
    law = PAPER.controller
    return PAPER.replace(Kp=law.Kp / times, Ki=law.Ki / times**2, Kd=0.0)


@pytest.fixture(scope="module")
def window() -> Window:
    run = simulate(PAPER, 6.1, reference=SquareWave(1e-3, 10.0), gap=GAP)
    return Window.from_run(run, 5.0, 1.0)


@pytest.mark.parametrize("times", [30.0, 100.0])
@pytest.mark.parametrize("noise_deg", [0.005, 0.02])
def test_a_noisy_encoder_keeps_its_motion_whatever_loop_is_stated(window: Window, times: float, noise_deg: float):
    """A low-pass for the stated loop would take away the motion, and the averages of a window exceed it."""
    model = stated_slower(times)
    noise = np.random.default_rng(1).normal(0.0, math.radians(noise_deg), window.samples)
    found = estimate_gap(window.replace(theta_m=window.theta_m + noise), model)
    assert found.ok, found.reasons
    assert abs(found.gap - GAP) < math.radians(0.01)
    assert found.interval[0] < GAP < found.interval[1]


@pytest.mark.parametrize("times", [1.0, 10.0, 100.0])
def test_a_load_that_swings_is_no_noise_behind_a_slow_loop(window: Window, times: float):
    swing = 1e-4 * np.sin(8.0 * math.pi * (window.time - window.start))
    found = estimate_gap(window.replace(position=window.position + swing), stated_slower(times))
    assert found.status is GapStatus.MODEL_MISMATCH
    assert found.reasons[0] == "the model leaves 6 % of the position's slow motion unexplained"


def test_the_structure_s_second_does_not_depend_on_the_loop():
    assert structure_time(PAPER) == scales(PAPER).time == 1.0
    assert structure_time(stated_slower(100.0)) == 1.0 < scales(stated_slower(100.0)).time
