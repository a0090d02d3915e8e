"""Gaps of several turns of the motor: large ones behind a gear of a high ratio."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import servotwin as st
from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput

# A quarter-turn valve: three degrees of the valve are 1200 of the motor.
VALVE = """
[actuator]
kind = "dc_motor"
inertia_kg_m2 = 3e-5
resistance_ohm = 0.9
inductance_h = 8e-4
torque_gain_n_m_per_a = 0.055
back_emf_v_s_per_rad = 0.055
coulomb_friction_n_m = 0.03
[transmission]
kind = "gear"
ratio = 400.0
[load]
kind = "rotary"
inertia_kg_m2 = 0.05
[sensors]
encoder_resolution_rad = 6.3e-3
position_resolution_rad = 3.8e-4
[controller]
kp_v_per_rad = 56.0
ki_v_per_rad_s = 126.0
kd_v_s_per_rad = 3.65
filter_time_s = 0.075
voltage_limit_v = 24.0
sample_rate_hz = 200.0
"""
SCENARIO = """
servo = "valve.toml"
duration_s = 60.0
reference = { kind = "square", amplitude_deg = 10.0, period_s = 60.0 }
gap = { total_deg = 1200.0 }
[twin]
enabled = false
"""
GAP = math.radians(1200.0)


def test_a_valve_moves_once_its_motor_has_crossed_three_turns_of_gap() -> None:
    axis = st.Axis.loads(VALVE, "valve.toml")
    run = st.simulate(axis, 60.0, reference=st.SquareWave(0.17, 60.0), gap=GAP, sample_rate=200.0)
    moved = np.flatnonzero(np.abs(run.position) > 0.0)[0]
    assert run.theta_m[moved - 1] <= 0.5 * GAP <= run.theta_m[moved]
    estimate = st.estimate_gap(st.Window.from_run(run, start=30.0, duration=2.0), axis)
    assert estimate.ok
    assert estimate.gap == pytest.approx(GAP, rel=0.01)


def test_a_scenario_of_a_slow_law_needs_no_window_of_its_own(tmp_path: Path) -> None:
    """400 samples of 200 Hz are longer than a usual window."""
    (tmp_path / "valve.toml").write_text(VALVE)
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO)
    scenario = Scenario.load(path)
    assert scenario.commissioning.window >= 2.0
    path.write_text(SCENARIO + "[recording]\nwindow_s = 1.0\n")
    with pytest.raises(InvalidInput, match=r"window = 1.0 s is too short for an? \w+"):
        Scenario.load(path)


def test_a_gap_of_more_than_a_turn_of_the_load_is_refused(tmp_path: Path) -> None:
    (tmp_path / "valve.toml").write_text(VALVE)
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO.replace("total_deg = 1200.0", "total_deg = 145000.0"))
    with pytest.raises(InvalidInput, match=r"gap.total_deg = 145000.* at most 144000 deg, one turn of the load"):
        Scenario.load(path)
    path.write_text(SCENARIO.replace("valve.toml", "paper").replace("amplitude_deg", "amplitude_mm"))
    with pytest.raises(InvalidInput, match=r"gap.total_deg = 1200.* at most 360 deg, one turn"):
        Scenario.load(path)


def test_a_stated_range_of_more_than_a_turn_is_refused_with_its_key(tmp_path: Path) -> None:
    (tmp_path / "valve.toml").write_text(VALVE)
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO + "[twin.uncertainty]\ngap_deg = [0.0, 145000.0]\n")
    with pytest.raises(InvalidInput, match=r"twin.uncertainty.gap_deg = .*145000.* at most 144000 deg, one turn of"):
        Scenario.load(path)
