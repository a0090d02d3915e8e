"""Keys of scenarios in the units of their machine."""

import math
from pathlib import Path

import pytest

import servotwin as st
from servotwin.cli.map.options import MapOptions
from servotwin.errors import InvalidInput
from servotwin.plant.scales import scales
from servotwin.redesign.certified.uncertainty import Uncertainty

ROTARY = """servo = "two-mass-drive"
duration_s = 4.0
[reference]
kind = "square"
amplitude_deg = 10.0
period_s = 4.0
[gap]
total_deg = 1.0
[disturbances]
input_bias_n_m = 0.25
[recording]
sample_rate_hz = 2000.0
[twin]
policy = "paper"
"""


def loaded(tmp_path: Path, text: str) -> st.Scenario:
    path = tmp_path / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return st.Scenario.load(path)


def test_a_rotary_axis_counts_in_degrees_and_in_its_command(tmp_path: Path) -> None:
    scenario = loaded(tmp_path, ROTARY + "[controller]\ntorque_limit_n_m = 12.0\n")
    assert scenario.reference.amplitude == pytest.approx(math.radians(10.0), rel=1e-15)  # type: ignore[union-attr]
    assert scenario.input_bias == 0.25
    assert scenario.law.voltage_limit == 12.0


def test_ranges_that_a_file_does_not_state_are_the_axis_s_own(tmp_path: Path) -> None:
    axis = st.Axis.preset("two-mass-drive")
    known, own, most = loaded(tmp_path, ROTARY).twin.uncertainty, scales(axis), 0.01 * axis.controller.voltage_limit
    assert known.step == pytest.approx([own.length * end for end in Uncertainty().step])
    assert most < 0.1 * own.voltage
    assert known.input_bias == pytest.approx([-most, most])
    stated = loaded(tmp_path, ROTARY + "[twin.uncertainty]\nstep_deg = [1.0, 20.0]\ninput_bias_n_m = [0.0, 0.5]\n")
    assert stated.twin.uncertainty.step == (math.radians(1.0), math.radians(20.0))
    assert stated.twin.uncertainty.input_bias == (0.0, 0.5)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("amplitude_deg", "amplitude_mm", "reference.amplitude_mm'.* counts it in rad; .*'reference.amplitude_deg'"),
        ("input_bias_n_m", "input_bias_v", "disturbances.input_bias_v'.* in N m; .*'disturbances.input_bias_n_m'"),
        ('"paper"', '"paper"\n[twin.uncertainty]\nstep_mm = [1.0, 2.0]', "step_mm'.*'twin.uncertainty.step_deg'"),
        ('"paper"', '"paper"\n[controller]\nvoltage_limit_v = 2.0', "here its name is 'controller.torque_limit_n_m'"),
        ("2000.0", "2000.0\n[recording.limits]\nmaximum_mm = 1.0", "in rad; .*'recording.limits.maximum_deg'"),
        ('"paper"', '"paper"\n[edge.watch]\neffort_floor_v = 1.0', "in N m; .*'edge.watch.effort_floor_n_m'"),
        ('"two-mass-drive"', '"paper"', "amplitude_deg'.* counts it in m; .*'reference.amplitude_mm'"),
        ('"two-mass-drive"', '"stepper-stage"', "amplitude_deg'.* counts it in m; .*'reference.amplitude_mm'"),
    ],
)
def test_another_unit_is_refused_in_a_sentence(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        loaded(tmp_path, ROTARY.replace(old, new))


def test_limits_and_watch_of_a_rotary_axis_count_in_its_units(tmp_path: Path) -> None:
    given = "[recording.limits]\nmaximum_deg = 2.0\n[edge.watch]\nerror_floor_deg = 0.5\neffort_floor_n_m = 0.1\n"
    scenario = loaded(tmp_path, ROTARY + given)
    assert scenario.recording.limits.maximum == pytest.approx(math.radians(2.0), rel=1e-15)
    assert scenario.supervision is not None
    watch = scenario.supervision.watch
    assert (watch.error_floor, watch.effort_floor) == (pytest.approx(math.radians(0.5), rel=1e-15), 0.1)


def test_a_map_of_a_rotary_axis_has_its_steps_in_degrees() -> None:
    rotary = MapOptions("two-mass-drive", gap_deg="1,2", amplitude_deg="10")
    assert rotary.settings().axes.amplitude == pytest.approx([math.radians(10.0)])  # type: ignore[union-attr]
    with pytest.raises(InvalidInput, match="--amplitude-mm 10: two-mass-drive has it in deg; give --amplitude-deg"):
        MapOptions("two-mass-drive", gap_deg="1,2", amplitude_mm="10").settings()
    with pytest.raises(InvalidInput, match="--still-um 3: two-mass-drive has it in mdeg; give --still-mdeg"):
        MapOptions("two-mass-drive", still_um=3.0).settings()
    assert MapOptions("two-mass-drive", still_mdeg=3.0).settings().still == pytest.approx(math.radians(3e-3))
