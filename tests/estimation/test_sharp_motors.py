"""Motors that start within few samples, and cross the gap before their encoder shows how."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.design import tune
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.output_error.between_samples import moved_between_samples
from servotwin.estimation.output_error.estimator import OutputErrorSettings, fit, problem_of
from servotwin.estimation.output_error.fit import Search, descend
from servotwin.estimation.output_error.held_chain import HeldChainModel
from servotwin.estimation.output_error.models import HALF
from servotwin.estimation.output_error.problem import Problem
from servotwin.estimation.output_error.refined import PARABOLA, refined
from servotwin.estimation.output_error.rounding import moved_by
from servotwin.estimation.window import Window
from servotwin.plant.actuator import DcMotor, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import Run, simulate

GAP, HALF_PERIOD, RATE = 0.162, 16.0, 335.0
# Its motor starts in 5 ms, less than two samples, and its load swings at 5 Hz behind 53 counts of gap.
MODEL = Axis(
    DcMotor(0.052, 0.1325, 0.44, 0.44, friction=0.016, coulomb=1.42),
    Transmission(0.19, 8760.0, 8.97, "held"),
    Load((9.08,), (0.0,), (1.9,), friction=0.61, force=20.0),
    Cascade(3.07, 0.19, 7.3, 0.26, 0.0052, sample_rate=RATE),
    Sensors(0.00304, 1.36e-5),
)
PLANT = MODEL.scaled({"k": 1.017, "c": 1.18, "k_T": 1.08, "k_B": 1.025, "motor_friction": 1.37, "load_friction": 1.39})


@lru_cache
def run_of(gap: float) -> Run:
    return simulate(PLANT, 8 * HALF_PERIOD, reference=SquareWave(1.76, 2 * HALF_PERIOD), gap=gap, sample_rate=RATE)


def window_of_step(step: int, gap: float = GAP) -> Window:
    return Window.from_run(run_of(gap), (step - 0.05) * HALF_PERIOD, 0.5 * HALF_PERIOD)


@lru_cache
def found_in(step: int) -> Search:
    return fit(window_of_step(step), MODEL, None, OutputErrorSettings())


@pytest.mark.slow
def test_gaps_that_a_sharp_start_hides_are_no_false_ones() -> None:
    """A low-pass alone on the motor's angle bent its start, and gaps of 1.6 times the true one were accepted."""
    for step in (3, 5, 6):
        found = estimate_gap(window_of_step(step), MODEL)
        if found.ok:
            assert found.interval[0] <= GAP <= found.interval[1]
        if found.status is GapStatus.LOWER_BOUND:
            assert found.gap <= GAP


@pytest.mark.slow
def test_the_smooth_angle_stays_within_what_the_encoder_showed() -> None:
    found, window = found_in(5), window_of_step(5)
    assert isinstance(found.problem, Problem)
    assert window.theta_m is not None
    beside = np.abs(found.problem.drive - MODEL.p * window.theta_m) / (MODEL.p * MODEL.encoder_resolution)
    assert 0.3 < beside.max() <= 1.0, "counts"
    # In slow motion it is smooth: its steps are no longer the encoder's.
    late = slice(round(2.3 * RATE), round(3.0 * RATE))
    steps = np.ptp(np.diff(found.problem.drive[late])), MODEL.p * np.ptp(np.diff(window.theta_m[late]))
    assert steps[0] < 0.5 * steps[1]


@pytest.mark.slow
def test_a_change_of_the_position_moves_the_gap_as_a_fit_of_the_changed_window_does() -> None:
    slow = MODEL.replace(actuator=replace(MODEL.actuator, R=2.0), sensors=Sensors(1e-5, 1e-7))
    run = simulate(slow, 24.0, reference=SquareWave(0.5, 16.0), gap=GAP, sample_rate=RATE)
    found = fit(Window.from_run(run, 7.5, 8.0), slow, None, OutputErrorSettings())
    problem, best = found.problem, found.best
    assert isinstance(problem, Problem)
    change = 1e-5 * np.sin(np.linspace(0.0, 20.0, problem.position.size))
    moved = replace(problem, position=problem.position - change)
    rate = problem.model.slowing[-1] * problem.model.speed
    again = descend(moved, best.values, found.noise, found.free, 30, rate)
    expected = moved_by(found, change[problem.margin : change.size - problem.margin])
    assert again.values[HALF] - best.values[HALF] == pytest.approx(expected, rel=0.2)
    assert abs(expected) > 1e-7


# Behind a drive in velocity mode, whose speed follows in three samples: the load swings at 95 Hz.
DRIVE = Axis(
    VelocityDrive(0.00258),
    Transmission(0.005156, 1305.7, 0.2088, "held"),
    Load((0.0036579,), (0.0,), (0.048666,), force=0.07137),
    Controller(0.0, 0.0, 0.0, 1.0),
    Sensors(2.7111e-4, 1.96e-7),
)
DRIVE_GAP, DRIVE_RATE = 0.14207, 1176.7


def drive_window(step: int, rate: float) -> tuple[Window, Axis]:
    """The window of a step of a machine whose numbers are a little off, and the model with its controller."""
    law = tune(DRIVE, 40.0, math.radians(60.0), kind="P").controller.replace(sample_rate=rate)
    plant, reference = DRIVE.scaled({"k": 0.988, "c": 0.86}), SquareWave(0.054, 2.5)
    run = simulate(plant, 3.75, controller=law, reference=reference, gap=DRIVE_GAP, sample_rate=rate)
    return Window.from_run(run, (step - 0.05) * 1.25, 0.625), DRIVE.replace(controller=law)


@pytest.mark.slow
def test_a_corner_of_the_motor_that_a_cubic_cuts_makes_no_false_gap() -> None:
    """Gaps 8 % too wide were accepted with half widths of 0.5 %: a cubic through both sides moved the start by 25
    counts, and left a quarter of one."""
    for step in (1, 2):
        found = estimate_gap(*drive_window(step, DRIVE_RATE))
        assert found.status in (GapStatus.OK, GapStatus.LOWER_BOUND)
        assert found.interval[0] <= DRIVE_GAP <= found.interval[1]


@pytest.mark.slow
def test_few_samples_of_a_sharp_start_are_refined_and_what_they_leave_open_counts() -> None:
    coarse, fine = (fit(*drive_window(1, rate), None, OutputErrorSettings()) for rate in (DRIVE_RATE, 4.0 * DRIVE_RATE))
    problem = coarse.problem
    assert isinstance(problem, Problem)
    assert isinstance(fine.problem, Problem)
    assert (problem.parts > 1, fine.problem.parts) == (True, 1)
    assert moved_between_samples(fine) == 0.0
    values = problem.model.start(0.5 * DRIVE_GAP * DRIVE.p, 0.0, problem.first())
    drive = refined(problem.drive, problem.parts, PARABOLA)
    apart = problem.less_measured(problem.under(drive, values).position) - problem.misfit(values)
    assert float(np.max(np.abs(apart))) > problem.count


def test_samples_are_not_averaged_over_a_corner() -> None:
    """Of a motor that starts at once, and of one that turns as slowly as its load swings."""
    rate, time = 6000.0, np.arange(12000) / 6000.0
    started = np.maximum(time - 1.0, 0.0)
    for motor, sharp in ((0.5 * np.sin(3.0 * time), False), (np.minimum(60.0 * started, 4.0), True)):
        window = Window(theta_m=motor, position=MODEL.p * motor, voltage=0.0 * motor, sample_rate=rate)
        problem, _ = problem_of(window, MODEL, None)
        assert isinstance(problem.model, HeldChainModel)
        averaged, usual = round(problem.interval * rate), problem.model.decimation(1.0 / rate, 12000 // 400)
        assert averaged <= 0.5 * usual if sharp else averaged == usual > 1
