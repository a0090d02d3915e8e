"""Gaps of axes made of parts whose driven end is held in the gap: the estimators are those of the paper's servo."""

import dataclasses
import math

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.plant.actuator import DcMotor, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import simulate

PAPER = Servo.preset("paper")
SCREW = Transmission(1e-3 / math.pi)
PARTS = Axis(
    DcMotor(PAPER.J, PAPER.R, PAPER.k_T, PAPER.k_B, PAPER.L),
    Transmission(PAPER.p),
    Load(tuple(PAPER.masses), tuple(PAPER.stiffnesses), tuple(PAPER.dampings)),
    PAPER.controller,
)


@pytest.mark.parametrize("method", ["whitened", "paper"])
def test_the_paper_s_servo_made_of_parts_has_the_same_estimate(method: str) -> None:
    run = simulate(PAPER, 8.0, reference=SquareWave(1e-3, 10.0), gap=0.2, noise=Noise(1e-6), seed=1)
    window = Window.from_run(run, 5.0, 2.0)
    ours, theirs = estimate_gap(window, PARTS, method), estimate_gap(window, PAPER, method)
    assert theirs.ok
    assert dataclasses.replace(ours, model_version=theirs.model_version) == theirs
    assert ours.model_version == PARTS.version


@pytest.mark.parametrize("free", [True, False])
def test_the_gap_of_a_velocity_drive_before_a_free_or_grounded_load(free: bool) -> None:
    load = Load((5.2, 5.2), (0.0 if free else 1e4, 1e4), (0.0, 36.9))
    axis = Axis(VelocityDrive(5e-3), SCREW, load, Controller(2e3, 4e3, 0.0, 0.1))
    axis.check_loop()
    run = simulate(axis, 8.0, reference=SquareWave(1e-3, 4.0), gap=0.2, noise=Noise(1e-6), seed=2)
    estimate = estimate_gap(Window.from_run(run, 1.9, 3.0), axis)
    assert estimate.ok, estimate.reasons
    assert abs(estimate.gap - 0.2) < 2e-3
    assert estimate.interval[0] < 0.2 < estimate.interval[1]


def test_an_elastic_screw_of_a_free_load_is_not_for_the_methods_of_a_servo() -> None:
    axis = dataclasses.replace(PARTS, transmission=Transmission(PAPER.p, 1e6))
    free = axis.replace(load=Load((5.2, 5.2), (0.0, 1e4), (0.0, 36.9)))
    window = Window(np.zeros(500), np.zeros(500), sample_rate=1e3)
    with pytest.raises(InvalidInput, match=r"load k\[0\] = 0.0"):
        estimate_gap(window, free, "whitened")


def test_a_coarse_encoder_shows_a_gap_of_a_tenth_of_a_micrometre_to_a_count() -> None:
    axis, at_load = Axis.preset("micro-positioner"), 1e-7
    run = simulate(axis, 3.0, reference=SquareWave(4e-6, 1.0), gap=at_load / axis.p, sample_rate=5000.0)
    estimate = estimate_gap(Window.from_run(run, 0.5, 1.5), axis)
    assert estimate.ok, estimate.reasons
    assert abs(estimate.gap - at_load / axis.p) < axis.encoder_resolution
    assert estimate.interval[0] < at_load / axis.p < estimate.interval[1]
