"""Motion that the model of a window leaves: the interval contains it, or the window is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from servotwin.control.controller import Controller
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.output_error import OutputErrorSettings
from servotwin.estimation.output_error.models import Priors, ShaftModel
from servotwin.estimation.output_error.unexplained import slow
from servotwin.estimation.window import Window
from servotwin.plant.actuator import VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.load import Load
from servotwin.plant.signals import SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import Run, simulate

TABLE = Axis(VelocityDrive(5e-3), Transmission(1e-3), Load((20.0,)), Controller(3e4, 1e4, 0.0, 0.1))


def test_slow_errors_are_told_from_white_noise() -> None:
    noise, time = np.random.default_rng(5).normal(size=4000), np.arange(4000) / 4000.0
    assert slow(noise, 40) < 0.05
    assert slow(noise + 0.3 * np.sin(6.0 * time), 40) > 0.1


@pytest.mark.slow
def test_a_sensor_that_errs_with_its_way_widens_the_interval_and_nothing_else_does() -> None:
    axis = Axis.preset("ball-screw")
    gap = 2e-5 / axis.p
    run = simulate(axis, 1.2, reference=SquareWave(3e-4, 0.8), gap=gap, sample_rate=2000.0)
    clean = Window.from_run(run, 0.38, 0.2)
    error = 0.25 * np.sin(2.0 * math.pi * clean.position / 8e-4 + 1.0)
    exact = estimate_gap(clean, axis)
    wrong = estimate_gap(clean.replace(position=clean.position + 2e-5 * error), axis)
    assert exact.ok, exact.reasons
    assert exact.interval[1] - exact.gap < 0.02 * gap
    assert wrong.ok, wrong.reasons
    assert abs(wrong.gap - gap) > 0.03 * gap, "the error of the sensor does not show in the gap"
    assert wrong.interval[0] <= gap <= wrong.interval[1]


@pytest.mark.slow
def test_slow_motion_that_may_hide_all_of_the_gap_is_refused() -> None:
    axis = Axis.preset("ball-screw")
    gap = 2e-5 / axis.p
    run = simulate(axis, 1.2, reference=SquareWave(3e-4, 0.8), gap=gap, sample_rate=2000.0)
    clean = Window.from_run(run, 0.78, 0.2)
    error = 1e-5 * np.sin(2.0 * math.pi * clean.position / 8e-4 + 1.0)
    estimate = estimate_gap(clean.replace(position=clean.position + error), axis)
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert "the model leaves slow motion that may hide" in estimate.reasons[0]


def driven(axis: Axis, run: Run, gap: float, softness: float) -> Window:
    """The load under a run's motor by small steps, behind a shaft that is softer over a tenth of its gap at first."""
    load, shaft, parts = axis.load, axis.transmission, 50
    mass, half, length = load.m[0], 0.5 * gap * axis.p, 0.2 * gap * axis.p
    motor = axis.p * np.interp(np.arange(parts * run.time.size) / parts, np.arange(run.time.size), run.theta_m)
    step, places, place, speed = run.time[1] / parts, [], run.position[0], 0.0
    for i in range(motor.size - 1):
        if i % parts == 0:
            places.append(place)
        lead, rate = motor[i] - place, (motor[i + 1] - motor[i]) / step - speed
        stretch = lead - min(max(lead, -half), half)
        pull = shaft.k_d * (stretch - softness * length * math.tanh(stretch / length)) + shaft.c_d * rate
        force = pull if pull * stretch > 0.0 else 0.0
        speed += step * (force - load.c[0] * speed) / mass
        rub = step * load.friction / mass
        speed -= min(max(speed, -rub), rub)
        place += step * speed
    count = axis.sensors.position_resolution
    position = count * np.round(np.array(places) / count)
    return Window(position, run.theta_m[: position.size], sample_rate=1.0 / run.time[1])


@pytest.mark.slow
def test_a_shaft_that_is_soft_at_first_contact_widens_the_interval_and_a_plain_one_does_not() -> None:
    axis = Axis.preset("ball-screw")
    gap = 1e-5 / axis.p
    run = simulate(axis, 0.8, reference=SquareWave(3e-4, 0.4), gap=gap, sample_rate=2000.0)
    plain, soft = (estimate_gap(driven(axis, run, gap, softness), axis) for softness in (0.0, 0.2))
    assert plain.ok, plain.reasons
    assert abs(plain.gap - gap) < 0.01 * gap
    assert plain.interval[1] - plain.gap < 0.03 * gap
    assert soft.ok, soft.reasons
    assert soft.gap > 1.03 * gap, "the soft shaft does not show in the gap"
    assert soft.interval[0] <= gap


CREEPING = """
[actuator]
kind = "velocity"
velocity_loop_time_s = 1e-3
[transmission]
kind = "screw"
lead_mm_per_rev = 0.02
stiffness_n_per_m = 2e4
damping_n_s_per_m = 4.0
in_gap = "free"
[load]
kind = "linear"
mass_kg = 0.01
damping_n_s_per_m = 2.0
friction_n = 0.001
[sensors]
position_resolution_m = 1e-10
[controller]
kp_rad_per_s_per_m = 3e6
ki_rad_per_s_per_m_s = 1e7
kd_rad_per_s_s_per_m = 0.0
filter_time_s = 1e-3
sample_rate_hz = 10000.0
"""


@pytest.mark.slow
def test_a_load_that_creeps_does_not_tell_friction_from_a_gap() -> None:
    """Behind half the gap and the shaft's wind-up by friction: a third of the friction and half as much gap again left
    as little, and that was accepted of a window twice as long (0.0771 rad, 0.0767 to 0.0775)."""
    axis, reasons = Axis.loads(CREEPING, "axis.toml"), []
    for gap in (0.05, 0.052):
        run = simulate(axis, 2.0, reference=SquareWave(1e-5, 4.0), gap=gap, sample_rate=2000.0)
        estimate = estimate_gap(Window.from_run(run, 0.0, 1.9), axis)
        assert not estimate.ok or estimate.interval[0] <= gap <= estimate.interval[1]
        reasons += estimate.reasons
    # Which reason comes first of one window depends on rounding.
    assert any("slow motion does not tell friction from a gap" in reason for reason in reasons), reasons
    quick = simulate(axis, 0.4, reference=SquareWave(1e-4, 0.4), gap=0.5, sample_rate=5000.0)
    assert estimate_gap(Window.from_run(quick, 0.0, 0.38), axis).ok


def test_friction_hides_in_the_gap_as_far_as_it_winds_up_the_shaft() -> None:
    axis = Axis.preset("ball-screw")
    model = ShaftModel(axis, Priors(0.05, 0.5, 0.1, 0.01, 1e-3))
    values = model.start(1e-5, 0.0, (0.0, 0.0))
    assert model.hidden_friction(values) == 0.0
    names = [unknown.name for unknown in model.unknowns]
    values[names.index("load friction")], values[names.index("shaft stiffness")] = math.log(3.0), math.log(2.0)
    wound = axis.load.friction / axis.transmission.k_d
    assert model.hidden_friction(values) == pytest.approx((3.0 - 1.0) * wound / 2.0)


@pytest.mark.slow
def test_errors_of_floating_point_are_no_mismatch_and_errors_in_a_few_places_are_one() -> None:
    axis, time = Axis.preset("stepper-stage"), np.arange(4000) / 1000.0
    axis = axis.replace(sensors=replace(axis.sensors, encoder_resolution=0.0, position_resolution=0.0))
    angle, gap = 0.5 * np.sin(6.0 * time), 0.05
    position = axis.p * play(angle, gap, -0.02)
    exact = estimate_gap(Window(position, angle, sample_rate=1000.0), axis)
    assert exact.ok, exact.reasons
    assert exact.gap == pytest.approx(gap, rel=1e-6)
    position[2000:2004] += 0.3 * axis.p * gap
    slipped = estimate_gap(Window(position, angle, sample_rate=1000.0), axis)
    assert slipped.status is GapStatus.MODEL_MISMATCH
    assert any("in a few places" in reason for reason in slipped.reasons), slipped.reasons


@pytest.mark.slow
def test_halves_that_differ_by_the_growth_that_is_told_are_no_mismatch() -> None:
    time = np.arange(4000) / 1000.0
    angle, gap = np.sin(6.0 * time), 0.05 * (1.0 + 0.02 * time)
    position = TABLE.p * play(angle, gap) + 1e-8 * np.random.default_rng(0).normal(size=time.size)
    window = Window(position, angle, sample_rate=1000.0)
    assert estimate_gap(window, TABLE).status is GapStatus.MODEL_MISMATCH
    told = estimate_gap(window, TABLE, settings=OutputErrorSettings(gap_rate=1e-3))
    assert told.ok, told.reasons
    assert told.interval[0] <= 0.052 <= told.interval[1]
