"""Files and presets of axes."""

from pathlib import Path

import pytest

import servotwin as st
from servotwin.errors import InvalidInput
from servotwin.plant.axis import AXES, Axis
from servotwin.plant.plants import resolve_plant

BALL_SCREW = Axis.preset("ball-screw")
TEXT = BALL_SCREW.dumps()


@pytest.mark.parametrize("name", AXES)
def test_a_preset_is_stable_and_reads_back_as_it_was_written(name: str) -> None:
    axis = Axis.preset(name)
    again = Axis.loads(axis.dumps(), "again.toml")
    assert again == axis
    assert again.version == axis.version
    margins = axis.margins()
    assert margins.stable
    assert margins.Ms < 2.0


@pytest.mark.parametrize("name", AXES)
def test_every_number_of_a_preset_has_a_source_or_is_called_assumed(name: str) -> None:
    """The head of the file says where its numbers are from."""
    folder = Path(st.__path__[0]) / "plant" / "presets"
    head = (folder / f"{name}.toml").read_text(encoding="utf-8").split("[actuator]")[0]
    assert head.startswith(f"# {name}: ")
    assert "assumed" in head


def test_a_file_resolves_as_a_servo_or_an_axis(tmp_path: Path) -> None:
    (tmp_path / "axis.toml").write_text(TEXT, encoding="utf-8")
    (tmp_path / "servo.toml").write_text(st.Servo.preset("table1").dumps(), encoding="utf-8")
    assert resolve_plant("axis.toml", tmp_path) == BALL_SCREW
    assert resolve_plant("servo.toml", tmp_path) == st.Servo.preset("table1")
    assert resolve_plant("gantry") == Axis.preset("gantry")
    assert resolve_plant("paper") == st.Servo.preset("paper")
    with pytest.raises(InvalidInput, match=r"preset 'gantri' does not exist \(did you mean 'gantry'\?\)"):
        resolve_plant("gantri", tmp_path)


def test_a_scenario_in_place_of_its_servo_is_called_one(tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text('servo = "ball-screw"\nduration_s = 2.0\n', encoding="utf-8")
    with pytest.raises(InvalidInput, match=r"scenario.toml: is a scenario.*key 'servo' names its servo, 'ball-screw'"):
        resolve_plant("scenario.toml", tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('kind = "torque"', 'kind = "torqe"', r"axis.toml: actuator.kind = 'torqe' .*did you mean 'torque'"),
        ("inertia_kg_m2 = 0.00012", "inertia_kg_m2 = -1.0", "inertia_kg_m2 = -1.0 is not allowed; give a positive"),
        ("inertia_kg_m2 = 0.00012", "inertia_kg_m2 = 1e-300", "farthest from 1 is actuator.inertia_kg_m2 = 1e-300"),
        ("mass_kg = [20.0]", "mass_kg = [1e-300]", r"cannot be computed; farthest from 1 is load.mass_kg = 1e-300"),
        ("stiffness_n_per_m = 50000000.0", "stiffness_n_per_m = 1e300", "transmission.stiffness_n_per_m = 1e[+]300"),
        ("sample_rate_hz = 2000.0", "sample_rate_hz = 1e-300", "controller.sample_rate_hz = 1e-300: check its unit"),
        ("pitch_m_per_rad", "pitch_mm_per_rad", "pitch_m_per_rad' or 'transmission.lead_mm_per_rev' is missing"),
        ("mass_kg = [20.0]", "mass_kg = [20.0, 0.0]", r"load.mass_kg\[1\] = 0.0 is not allowed"),
        ("mass_kg = ", "inertia_kg_m2 = ", r"load.inertia_kg_m2 = \[20.0\]: this load is linear; give load.mass_kg"),
        ("pitch_m_per_rad = ", "lead_mm_per_rev = 5.0\npitch_m_per_rad = ", "give only one of them"),
        (
            "friction_n = 15.0",
            "friction_n = 15.0\nstatic_friction_n = 20.0",
            "load static_friction_n: needs stribeck_speed_m_per_s too",
        ),
        (
            "friction_n = 15.0",
            "friction_n = 15.0\nstatic_friction_n = 10.0\nstribeck_speed_m_per_s = 0.01",
            r"static_friction_n = 10.0 N: must be at least friction_n = 15.0 N",
        ),
        ("friction_n = 15.0", "friction_n = 15.0\nstribeck_sped_m_per_s = 0.1", "stribeck_speed_m_per_s"),
        (
            "mass_kg = [20.0]",
            "mass_kg = [20.0, 3.0]",
            r"load k \(stiffness_n_per_m\) = \(0.0,\): must have one value for each",
        ),
        ('kind = "linear"', 'kind = "rotary"', 'rotary\' is not allowed; give "linear", for the transmission'),
        ("kp_n_m_per_m", "kp_v_per_m", r"in N m/m; here its name is 'controller.kp_n_m_per_m'"),
        ("kp_n_m_per_m = 1500.0", "kp_n_m_per_m = nan", "controller.kp_n_m_per_m = nan is not allowed"),
        ("kp_n_m_per_m = 1500.0", "kp_n_m_per_m = -1500.0", r"Kp = -1500 N m/m, .* unstable on this axis"),
        ("torque_limit_n_m", "torque_limt_n_m", "controller.torque_limt_n_m.*did you mean 'torque_limit_n_m'"),
        ('feedback = "load"', 'feedback = "screw"', "feedback = 'screw' is not allowed; give one of load, motor"),
        ("[load]", "[lod]", r"table \[load\] is missing"),
        ("stiffness_n_per_m = 50000000.0", "stiffness_n_per_m = inf", "needs a finite stiffness_n_per_m"),
        (
            "stiffness_n_per_m = 50000000.0",
            "stiffness_n_m_per_rad = 5e7",
            r"unknown key 'transmission.stiffness_n_m_per_rad'.*allows .*stiffness_n_per_m",
        ),
        (
            "stiffness_n_per_m = 50000000.0\ndamping_n_s_per_m = 6000.0\nin_gap = \"free\"",
            "damping_n_s_per_m = 6000.0",
            r"damping_n_s_per_m = 6000.0 N s/m: needs a finite stiffness_n_per_m, beside which it damps",
        ),
        (
            "mass_kg = [20.0]\nstiffness_n_per_m = [0.0]\ndamping_n_s_per_m = [100.0]",
            "mass_kg = [20.0, 3.0]\nstiffness_n_per_m = [0.0, 0.0]\ndamping_n_s_per_m = [100.0, 0.0]",
            r"load k\[1\] \(stiffness_n_per_m\) = 0.0 N/m: must be finite and positive",
        ),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_a_sentence(old: str, new: str, words: str) -> None:
    assert old in TEXT
    with pytest.raises(InvalidInput, match=words) as error:
        Axis.loads(TEXT.replace(old, new, 1), "axis.toml")
    assert str(error.value).startswith("axis.toml")
    assert "\n" not in str(error.value)
