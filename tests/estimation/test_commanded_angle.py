"""Axes whose motor has no encoder: the angle of a drive that follows its command comes from the command."""

import math
from dataclasses import replace

import numpy as np
import pytest

import servotwin as st
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation.commanded_angle import with_commanded_angle
from servotwin.plant.actuator import Stepper
from servotwin.plant.axis import Axis
from servotwin.plant.load import LINEAR, Load
from servotwin.plant.sensors import Sensors
from servotwin.plant.transmission import Transmission


def without_encoder(axis: Axis) -> Axis:
    sensors = replace(axis.sensors, encoder_resolution=0.0, motor_encoder=False)
    return axis.replace(sensors=sensors)


STAGE = without_encoder(Axis.preset("stepper-stage"))


@pytest.fixture(scope="module")
def stage_run() -> st.Run:
    """The stage in steps of 40 um, with a gap of 8.0 degrees."""
    return st.simulate(STAGE, 2.0, reference=st.SquareWave(40e-6, 4.0 / 3.0), gap=math.radians(8.0))


def test_a_window_of_a_motor_without_encoder_has_no_angle(stage_run: st.Run) -> None:
    window = st.Window.from_run(stage_run, start=0.0, duration=2.0)
    assert window.theta_m is None
    assert set(window.channels) == {"position", "voltage", "reference"}
    assert not [name for name in stage_run.columns if "theta_m" in name]
    assert np.isnan(stage_run.measured_theta_m).all()


def test_the_angle_of_a_stepper_comes_from_its_command(stage_run: st.Run) -> None:
    window = st.Window.from_run(stage_run, start=0.3, duration=1.0)  # in the middle of a motion
    made = with_commanded_angle(window, STAGE)
    first = round((made.start - window.start) * window.sample_rate) + round(0.3 * window.sample_rate)
    true = stage_run.theta_m[first : first + made.samples]
    assert 0.0 < made.start - window.start < 0.1
    assert np.abs(made.theta_m - true).max() < 1e-5 * np.ptp(true)


@pytest.mark.slow
def test_the_gap_of_a_stepper_without_encoder_is_estimated(stage_run: st.Run) -> None:
    estimate = st.estimate_gap(st.Window.from_run(stage_run, start=0.0, duration=2.0), STAGE)
    assert estimate.ok, estimate.reasons
    assert estimate.interval[0] <= math.radians(8.0) <= estimate.interval[1]
    assert abs(estimate.gap - math.radians(8.0)) < 0.01 * math.radians(8.0)
    assert estimate.model_version == STAGE.version


@pytest.mark.parametrize("sampled", [True, False])
def test_the_angle_of_a_velocity_drive_comes_from_its_command_but_for_its_begin(sampled: bool) -> None:
    axis = without_encoder(Axis.preset("telescope"))
    rate = 200.0 if sampled else 2000.0
    axis = axis if sampled else axis.replace(sample_rate=None)
    run = st.simulate(axis, 20.0, reference=st.SquareWave(1e-3, 16.0), gap=math.radians(11.0), sample_rate=rate)
    made = with_commanded_angle(st.Window.from_run(run, start=1.0, duration=18.0), axis)
    first = round(made.start * rate)
    off = made.theta_m - run.theta_m[first : first + made.samples]
    assert np.ptp(off) < (1e-6 if sampled else 1e-5) * np.ptp(run.theta_m)
    assert made.theta_m[0] == pytest.approx(made.position[0] / axis.p, rel=1e-12)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"encoder_resolution": 1e-3}, "encoder_resolution_rad = 0.001 rad is of one"),
        ({"encoder_counts": 4096.0}, "encoder_counts_per_rev = 4096.0 counts per turn is of one"),
        ({"encoder_noise": 1e-3}, "encoder_noise_rad = 0.001 rad is of one"),
        ({"encoder_offset": 0.1}, "encoder_offset_rad = 0.1 rad is of one"),
        ({"encoder_delay": 0.1}, "encoder_delay_s = 0.1 s is of one"),
        ({"feedback": "motor"}, 'feedback = "motor" reads it; give feedback = "load"'),
    ],
)
def test_what_needs_the_motors_encoder_is_refused_without_one(keys: dict[str, object], words: str) -> None:
    with pytest.raises(InvalidInput) as error:
        Sensors(motor_encoder=False, **keys)
    assert "motor_encoder = false" in str(error.value)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_law_that_reads_the_motor_is_refused_without_its_encoder() -> None:
    axis = without_encoder(Axis.preset("ball-screw"))
    cascade = Cascade(20.0, axis.p, velocity_gain=0.5, sample_rate=2000.0)
    with pytest.raises(InvalidInput, match="motor_encoder = false: the controller reads y_motor"):
        axis.replace(controller=cascade)


def test_a_window_with_an_angle_that_nothing_measured_is_refused(stage_run: st.Run) -> None:
    window = st.Window.from_run(stage_run, start=0.0, duration=1.0).replace(theta_m=stage_run.theta_m[:5000])
    with pytest.raises(InvalidInput, match="the window has theta_m, which no encoder gives"):
        st.estimate_gap(window, STAGE)


def test_the_key_is_written_where_it_is_needed_only() -> None:
    assert "motor_encoder" not in Axis.preset("stepper-stage").dumps()
    assert "motor_encoder = false" in STAGE.dumps()
    assert Axis.loads(STAGE.dumps(), "axis.toml") == STAGE
    assert STAGE.version != Axis.preset("stepper-stage").version


def elastic_stage(seed: int) -> tuple[Axis, Axis, st.SquareWave, float]:
    """A stepper before an elastic screw under integral action; its machine, amplitude's square wave, and gap in rad."""
    random = np.random.default_rng(seed)
    load = Load((0.004,), (0.0,), (0.0077,), LINEAR, 0.0, -0.059)
    law = Controller(0.0, 91.0, 0.0, 1.0, sample_rate=1122.0)
    sensors = Sensors(0.0, 1.45e-6, motor_encoder=False)
    axis = Axis(Stepper(2.7e-3), Transmission(0.025, 360.0, 0.24, "held"), load, law, sensors)
    errors = {"k": 1.0 + 0.05 * random.uniform(-1.0, 1.0), "c": 1.0 + 0.3 * random.uniform(-1.0, 1.0)}
    return axis, axis.scaled(errors), st.SquareWave(0.125, 6.6), math.radians(18.6)


def test_a_motion_one_way_of_a_stepper_behind_an_elastic_screw_is_refused() -> None:
    axis, plant, reference, gap = elastic_stage(41)
    run = st.simulate(plant, 6.6, reference=reference, gap=gap, sample_rate=1122.0)
    estimate = st.estimate_gap(st.Window.from_run(run, start=3.14, duration=1.65), axis)
    assert not estimate.ok
    assert "the load moves one way" in estimate.reasons[0] or "one flank" in estimate.reasons[0]


def test_a_motion_to_and_fro_shows_its_gap() -> None:
    axis, plant, _, gap = elastic_stage(41)
    run = st.simulate(plant, 6.6, reference=st.SquareWave(0.125, 2.2), gap=gap, sample_rate=1122.0)
    estimate = st.estimate_gap(st.Window.from_run(run, start=2.0, duration=3.3), axis)
    assert estimate.ok, estimate.reasons
    assert estimate.interval[0] <= gap <= estimate.interval[1]
