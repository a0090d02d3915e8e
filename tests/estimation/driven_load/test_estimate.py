"""Gaps between two encoders, told from wind-up by friction with the load's dynamics."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from recordings import recording
from typer.testing import CliRunner

from servotwin.cli.app import app
from servotwin.control.controller import Controller
from servotwin.estimation.driven_load.estimate import gap_of_driven_load, load_of, with_dynamics
from servotwin.estimation.driven_load.problem import ONE_MASS, DrivenLoad, Links, LoadDynamics
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.kinematic.lost_motion import LostMotion, estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.wind_up import gap_within
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import ROTARY, Load
from servotwin.plant.transmission import Transmission

GAP, FREQUENCY, FRICTION = 0.02, 60.0, 0.002  # rad, rad/s, rad: the wind-up is a fifth of the gap
UNKNOWN = LostMotion(math.nan, math.inf, (0.0, math.inf), 1.03, 1.0, 0.0, GapStatus.MODEL_MISMATCH, ("it swings",))


def swinging(seconds=6.0, rate=250.0, speed=1.0, links=ONE_MASS, friction=FRICTION):
    """A weakly damped load that swings through its gap, both positions counted."""
    time = np.arange(0.0, seconds, 1.0 / rate)
    motor = 0.2 * np.sin(4.0 * speed * time) + 0.08 * np.sin(10.3 * speed * time + 1.0)
    load = LoadDynamics(FREQUENCY, 0.05, friction, 0.01, links)
    blank = EncoderRecording(time, motor, np.zeros(time.size))
    problem = DrivenLoad(load, blank, 1.0, 0.0, ())
    values = problem.model.start(0.5 * GAP, 0.0, (0.0, 0.0))
    moved = problem.misfit(values)
    count = 2e-5
    return replace(blank, motor=np.round(motor / count) * count, load=np.round((moved + 0.5) / count) * count)


@pytest.fixture(scope="module")
def made():
    return swinging()


@pytest.fixture(scope="module")
def found(made):
    return gap_of_driven_load(made, UNKNOWN)


def test_the_gap_is_told_from_the_wind_up_of_an_unknown_load(found):
    assert found.reason == ""
    assert found.gap.ok
    assert found.gap.gap_motor == pytest.approx(GAP, rel=2e-3)
    low, high = found.gap.interval_motor
    assert low < GAP < high
    assert found.gap.lost.at_motor == pytest.approx(GAP + 2.0 * FRICTION, rel=0.02)
    assert found.gap.lost.ratio == pytest.approx(1.0, rel=1e-3)
    assert found.gap.lost.model == "two masses"


def test_the_picture_shows_what_the_dynamics_leave(found):
    curves = found.gap.lost.curves
    assert curves.time.size == curves.load.size == curves.residual.size
    assert np.sqrt(np.mean(curves.residual**2)) == pytest.approx(found.gap.lost.rms)
    # The motor leads by half the gap and the wind-up where it pushes.
    assert 0.5 * GAP < np.quantile(np.abs(curves.lead), 0.9) < 2.0 * GAP


def test_the_dynamics_of_the_load_are_found_too(found):
    assert found.dynamics.frequency == pytest.approx(FREQUENCY, rel=5e-3)
    assert found.dynamics.friction == pytest.approx(FRICTION, rel=2e-2)


def test_friction_is_never_so_well_known_that_its_wind_up_does_not_widen_the_interval(found):
    low, high = found.gap.interval_motor
    assert 0.5 * (high - low) >= 2.0 * 0.9 * FRICTION


def test_slow_strokes_without_dynamics_show_no_gap():
    made = recording(seconds=4.0, rate=50.0)
    lost = LostMotion(0.05, 1e-4, (0.049, 0.051), 0.1, 1.0, 0.0, GapStatus.OK)
    known = with_dynamics(made, gap_within(lost, None))
    assert known.status is GapStatus.LOST_MOTION
    assert math.isnan(known.gap_motor)
    assert "the load's dynamics do not show the gap" in known.reasons[0]


def test_too_few_strokes_are_said_to_be_too_few(made):
    short = replace(made, time=made.time[:200], motor=made.motor[:200], load=made.load[:200])
    answer = gap_of_driven_load(short, UNKNOWN)
    assert answer.gap is None
    assert "too few" in answer.reason


@pytest.mark.slow
def test_the_longest_part_without_a_pause_counts(made, found):
    later = replace(made, time=made.time + 60.0)
    parts = [(made, slice(0, 200)), (later, slice(None))]
    joined = EncoderRecording(
        *(np.concatenate([getattr(each, name)[part] for each, part in parts]) for name in ("time", "motor", "load"))
    )
    answer = gap_of_driven_load(joined, UNKNOWN)
    # Times that are rounded otherwise lead the search on another way: by a hundredth of its standard deviation.
    assert answer.gap.gap_motor == pytest.approx(found.gap.gap_motor, abs=0.02 * found.gap.std_motor)


def test_the_table_of_models_says_why_the_dynamics_were_taken_or_not(found, made):
    taken = found.trial()
    assert (taken.name, taken.gap) == ("two masses", found.gap.lost.at_motor)
    assert re.match(r"taken: \d+(\.\d+)? % of the error of play alone on unseen strokes, 9\.5\d? Hz", taken.evidence)
    known = LoadDynamics(1e4, 0.1, 0.0)
    fast = gap_of_driven_load(made, UNKNOWN, known)
    assert fast.trial().evidence.startswith("not taken: the load swings too fast for the recording: record at ")


def test_a_machines_load_is_its_masses_on_its_stiffness_with_its_friction():
    axis = Axis.preset("two-mass-drive")
    load = load_of(axis, 1e-3)
    mass = sum(axis.load.m)
    assert load.frequency == pytest.approx(math.sqrt(axis.transmission.k_d / mass))
    assert load.friction == pytest.approx(1e3 * axis.guide.friction / axis.transmission.k_d)
    stiff = axis.replace(transmission=replace(axis.transmission, k_d=math.inf, c_d=0.0, in_gap="held"))
    assert load_of(stiff, 1.0) is None


def test_a_gap_that_is_known_is_left_as_it_is(made):
    lost = LostMotion(0.05, 1e-4, (0.049, 0.051), 0.1, 1.0, 0.0, GapStatus.OK)
    known = gap_within(lost, 0.0)
    assert with_dynamics(made, known) is known


CHAIN = Links((0.4, 0.6), (0.7,), (0.02,))


def drive_axis(friction=1.0, n=2):
    """A machine that is known within some per cent; 1 kg on the spring of `swinging` in all."""
    k = 1.1 * FREQUENCY**2
    masses = (0.42, 0.62)[-n:] if n > 1 else (1.05,)
    springs, dampers = ((0.0, 0.75 * k), (1.0, 2.0)) if n > 1 else ((0.0,), (0.0,))
    load = Load(masses, springs, dampers, ROTARY, friction=friction * k * FRICTION)
    return Axis(TorqueDrive(1.0), Transmission(1.0, k, 5.0, in_gap="free"), load, Controller(0, 0, 0, 1.0))


@pytest.mark.slow
def test_a_chain_of_masses_is_tried_where_the_axis_has_one_and_one_mass_does_not_do():
    made = swinging(seconds=12.0, links=CHAIN, friction=0.2 * FRICTION)
    alone = with_dynamics(made, gap_within(UNKNOWN, None))
    assert not alone.ok
    assert alone.dynamics.name == "two masses"
    known = with_dynamics(made, gap_within(UNKNOWN, None), drive_axis(friction=0.2))
    assert known.ok
    assert known.lost.model == "chain of 3 masses"
    low, high = known.interval_motor
    assert low < GAP < high
    assert known.lost.at_motor == pytest.approx(GAP + 0.4 * FRICTION * (1.0 + 1.0 / 0.7), rel=0.1)


@pytest.mark.slow
def test_a_machine_without_friction_and_damping_may_be_given(made):
    known = with_dynamics(made, gap_within(UNKNOWN, None), drive_axis(friction=0.0, n=1))
    assert known.dynamics is not None


def test_a_chain_begins_where_the_fit_found_it():
    axis = drive_axis()
    load = load_of(axis, 1.0)
    assert load.name == "chain of 3 masses"
    assert sum(load.links.masses) == pytest.approx(1.0)
    made = DrivenLoad(load, swinging(), 1.0, 0.0, ())
    assert load.moved(made.model, made.model.start(0.0, 0.0, (0.0, 0.0))) == load
    other = load.machine()
    assert other.load.k[1] / other.transmission.k_d == pytest.approx(0.75)


def test_a_stiff_load_whose_counts_a_swinging_one_would_smooth_is_not_said_to_swing():
    stiff = recording(seconds=20.0, rate=500.0, ratio=1.0, noise=0.0, count=2e-3)
    stiff = replace(stiff, load=np.round(stiff.load / 1e-3) * 1e-3)
    found = with_dynamics(stiff, gap_within(estimate_lost_motion(stiff), None))
    assert found.status is GapStatus.LOST_MOTION


@pytest.mark.slow
def test_identify_tries_dynamics_by_itself_where_the_load_swings(tmp_path):
    made = swinging(seconds=12.0)
    rows = np.column_stack([made.time, made.motor, made.load])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="time [s],motor [rad],load [rad]", comments="")
    ran = CliRunner().invoke(app, ["identify", str(tmp_path / "log.csv"), "--json"])
    found = json.loads(ran.stdout)
    assert (found["status"], found["model_kind"]) == ("ok", "two masses")
    low, high = found["interval_motor"]
    assert low < GAP < high
