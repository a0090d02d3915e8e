"""Scenarios whose twin is switched off: plain simulations, on every axis."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import servotwin as st
from servotwin.cli.app import app
from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput

SCENARIO = """servo = "{servo}"
duration_s = 1.0
[reference]
kind = "square"
amplitude_{unit} = 1.0
period_s = 1.0
[gap]
total_deg = 0.5
{twin}
"""
OFF = "[twin]\nenabled = false\n"


def file_of(folder: Path, servo: str, twin: str, unit: str = "mm") -> Path:
    path = folder / "scenario.toml"
    path.write_text(SCENARIO.format(servo=servo, unit=unit, twin=twin), encoding="utf-8")
    return path


def test_a_picture_without_any_estimate_names_the_loop_and_no_trend(tmp_path: Path) -> None:
    figure = cosimulate(Scenario.load(file_of(tmp_path, "emps", OFF))).plot()
    assert figure.get_suptitle() == "Loop 'servo': 1 s, windows: 0, updates: 0 sent, 0 applied"


@pytest.mark.parametrize(("servo", "unit"), [("emps", "mm"), ("gantry", "mm"), ("robot-joint", "deg")])
def test_every_axis_runs_with_its_own_controller(tmp_path: Path, servo: str, unit: str) -> None:
    scenario = Scenario.load(file_of(tmp_path, servo, OFF, unit))
    loop, axis = cosimulate(scenario), st.Axis.preset(servo)
    alone = st.simulate(
        axis, 1.0, reference=scenario.reference, gap=scenario.gap, sample_rate=axis.controller.sample_rate
    )
    assert np.array_equal(loop.run.position, alone.position)
    assert np.array_equal(loop.run.voltage, alone.voltage)
    assert np.ptp(loop.run.position) > 0.0
    assert loop.windows == loop.estimates == loop.updates == ()


def test_a_dead_zone_is_that_of_the_assumed_gap(tmp_path: Path) -> None:
    scenario = Scenario.load(file_of(tmp_path, "gantry", OFF + "initial_gap_deg = 1.0\n"))
    assert scenario.start_tolerance == scenario.servo.tolerance_for(np.radians(1.0), 1.0) > 0.0


def test_the_command_says_that_there_is_no_twin(tmp_path: Path) -> None:
    path = file_of(tmp_path, "emps", OFF)
    shown = CliRunner().invoke(app, ["simulate", str(path), "-o", str(tmp_path / "run.npz")])
    assert shown.exit_code == 0, shown.output
    assert "1 s, no twin" in shown.output
    assert (tmp_path / "run.npz").exists()


@pytest.mark.parametrize("twin", ["", "[twin]\nenabled = true\n"])
def test_a_twin_that_can_verify_nothing_is_refused(tmp_path: Path, twin: str) -> None:
    with pytest.raises(InvalidInput, match=r"sensors\.feedback = \"motor\".*; without a twin .* enabled = false in"):
        Scenario.load(file_of(tmp_path, "emps", twin))


@pytest.mark.parametrize(
    ("servo", "twin", "words"),
    [
        ("emps", 'policy = "paper"\nk_dz = 0.0\n', "the motor's encoder and the command do not show the gap"),
        ("ball-screw", 'policy = "margin"\n', 'policy = "margin": is computed for one gap and scaled to others'),
    ],
)
def test_a_twin_that_cannot_work_with_the_axis_is_refused_with_the_file_before_anything_runs(
    tmp_path: Path, servo: str, twin: str, words: str
) -> None:
    with pytest.raises(InvalidInput, match=rf"scenario\.toml: {words}.*; without a twin .* enabled = false in"):
        Scenario.load(file_of(tmp_path, servo, f"[twin]\n{twin}"))
    assert not Scenario.load(file_of(tmp_path, servo, OFF + twin)).twin.enabled


def test_an_edge_whose_twin_is_away_keeps_its_policy(tmp_path: Path) -> None:
    path = file_of(tmp_path, "paper", OFF + 'policy = "certified"\n')
    scenario = Scenario.load(path)
    assert scenario.twin.policy == "certified"
    assert scenario.start.fallback
