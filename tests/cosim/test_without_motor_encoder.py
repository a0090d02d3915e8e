"""Scenarios of axes whose motor has no encoder: with a twin where the angle follows from the command, else without."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from stage_scenario import stage
from typer.testing import CliRunner

import servotwin as st
from servotwin.cli.app import app
from servotwin.config.table import parse_toml
from servotwin.cosim import cosimulate
from servotwin.cosim.machine import endless
from servotwin.cosim.scenario import Scenario
from servotwin.edge_process.config import UNBOOTED, EdgeConfig
from servotwin.edge_process.config_file import edge_toml, read_config
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.simulation.endless import OpenLoopPlant

SCENARIO = """servo = "axis.toml"
duration_s = 4.0
[reference]
kind = "square"
amplitude_mm = 10.0
period_s = 2.0
[gap]
total_deg = 1.0
[twin]
"""


def without_encoder(axis: Axis) -> Axis:
    return axis.replace(sensors=dataclasses.replace(axis.sensors, encoder_resolution=0.0, motor_encoder=False))


def file_of(folder: Path, twin: str) -> Path:
    """A ball screw's torque drive, whose motor's angle does not follow from its command."""
    (folder / "axis.toml").write_text(without_encoder(Axis.preset("ball-screw")).dumps(), encoding="utf-8")
    path = folder / "scenario.toml"
    path.write_text(SCENARIO + twin, encoding="utf-8")
    return path


@pytest.mark.slow
def test_the_twin_of_a_stepper_without_encoder_knows_its_gap() -> None:
    made = stage((5, 1), duration=40.0)
    loop = made._replace(scenario=made.scenario.replace(servo=without_encoder(made.scenario.model))).run()
    assert all(window.channel("theta_m") is None for window in loop.windows)
    assert len(loop.windows) == 7
    accepted = [each for each in loop.estimates if each.ok]
    assert len(accepted) >= 4
    for each in accepted:
        assert each.interval[0] <= made.gap <= each.interval[1]
        assert abs(each.gap - made.gap) < 0.01 * made.gap
    assert loop.trend is not None


def test_a_twin_of_an_angle_that_nothing_shows_is_refused_with_the_file(tmp_path: Path) -> None:
    path = file_of(tmp_path, 'policy = "paper"\nk_dz = 0.0\n')
    words = r"scenario\.toml: sensors motor_encoder = false: .* command in N m; .* enabled = false in"
    with pytest.raises(InvalidInput, match=words):
        Scenario.load(path)
    shown = CliRunner().invoke(app, ["simulate", str(path), "-o", str(tmp_path / "run.npz")])
    assert shown.exit_code == 2
    assert not (tmp_path / "run.npz").exists()


def test_without_its_twin_it_runs_as_with_an_encoder(tmp_path: Path) -> None:
    scenario = Scenario.load(file_of(tmp_path, "enabled = false\n"))
    loop = cosimulate(scenario)
    measured = st.simulate(
        Axis.preset("ball-screw"), 4.0, reference=scenario.reference, gap=scenario.gap, sample_rate=2000.0
    )
    assert np.array_equal(loop.run.position, measured.position)
    assert np.array_equal(loop.run.theta_m, measured.theta_m)
    axis = scenario.model
    assert axis.margins() == Axis.preset("ball-screw").margins()
    window = st.Window.from_run(loop.run, start=0.0, duration=1.0)
    with pytest.raises(InvalidInput, match="motor_encoder = false: an estimate of the gap needs the motor's angle"):
        st.estimate_gap(window, axis)
    assert math.isnan(loop.run.measured_theta_m[0])


def test_its_edge_and_its_simulated_drive_have_no_angle() -> None:
    """What enrolment writes comes back, and the machine under the edge's command gives NaN for the angle."""
    scenario = stage((5, 1)).scenario
    scenario = scenario.replace(servo=without_encoder(scenario.model))
    agent = dataclasses.replace(scenario.agent_settings(), boot=UNBOOTED, controller=None)
    config = EdgeConfig(agent, "control", scenario.law, {"kind": "simulated"}, command_unit="rad")
    text = edge_toml(config)
    assert "motor_encoder = false" in text
    assert read_config(parse_toml(text, "edge.toml")).agent.motor_encoder is False
    plant = OpenLoopPlant(endless(scenario, 16))
    plant.hold(0.1)
    reference, angle, position = plant.sample()
    assert math.isnan(angle)
    assert math.isfinite(reference + position)
