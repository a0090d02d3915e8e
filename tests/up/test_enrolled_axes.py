"""Enrolling servos with controllers of their own: the edge's file has the one that runs, at its own rate."""

import json
import math
import tomllib
from pathlib import Path

import jsonschema_rs
import pytest

from servotwin.cli.configuration import texts
from servotwin.config.table import parse_toml
from servotwin.config.units import unit_of
from servotwin.control.linear_law import LinearLaw
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.config_file import edge_toml, load, read_config
from servotwin.errors import InvalidInput
from servotwin.plant.axis import AXES, Axis
from servotwin.up.enrolment import Enrolment, StatedNoise, enroll

TWIN = """
[service]
tokens = "tokens.toml"
[models.own]
servo = "{servo}"
[models.own.twin]
policy = "paper"
k_dz = 0.0
[servos]
"ax-*" = "own"
"""


def enrolled(folder: Path, servo: str, **request: object) -> EdgeConfig:
    (folder / "twin.toml").write_text(TWIN.format(servo=servo))
    enroll(folder / "twin.toml", Enrolment("ax-1", folder / "edge", **request))
    return load(folder / "edge" / "edge.toml")


@pytest.mark.parametrize("role", ["supervise", "control"])
@pytest.mark.parametrize("name", AXES)
def test_the_edge_has_the_axis_s_own_controller_and_rate(tmp_path: Path, name: str, role: str) -> None:
    axis = Axis.preset(name)
    config = enrolled(tmp_path, name, role=role)
    assert config.controller == axis.controller
    assert config.agent.sample_rate == axis.controller.sample_rate


def test_a_drive_s_controller_keeps_its_rate_where_the_edge_samples_at_another(tmp_path: Path) -> None:
    config = enrolled(tmp_path, "two-mass-drive", sample_rate=1000.0)
    assert config.agent.sample_rate == 1000.0
    assert config.controller == Axis.preset("two-mass-drive").controller


def test_the_edge_ticks_a_cascade_at_the_rate_of_its_samples(tmp_path: Path) -> None:
    config = enrolled(tmp_path, "two-mass-drive", role="control", sample_rate=1000.0)
    assert config.controller == Axis.preset("two-mass-drive").controller.replace(sample_rate=1000.0)


def test_a_log_to_replay_must_be_where_the_edge_will_look_for_it(tmp_path: Path) -> None:
    drive = {"kind": "replay", "log": "run.csv"}
    with pytest.raises(InvalidInput, match=r"edge/edge\.toml: drive\.log = 'run\.csv': .*run\.csv: cannot be read"):
        enrolled(tmp_path, "two-mass-drive", drive=drive)
    assert {path.name for path in tmp_path.iterdir()} <= {"twin.toml", "tokens.toml-lock"}
    (tmp_path / "edge").mkdir()
    (tmp_path / "edge" / "run.csv").write_text("time_s,reference_rad,theta_m_rad,position_rad,command_n_m\n0,0,0,0,0\n")
    assert enrolled(tmp_path, "two-mass-drive", drive=drive).drive == drive


@pytest.mark.parametrize(("role", "kind"), [("supervise", "replya"), ("control", "replay")])
def test_a_kind_of_drive_that_the_role_does_not_have_is_refused(tmp_path: Path, role: str, kind: str) -> None:
    with pytest.raises(InvalidInput, match=f"drive.kind = '{kind}' is not allowed"):
        enrolled(tmp_path, "two-mass-drive", drive={"kind": kind, "log": "run.csv"}, role=role)
    assert not (tmp_path / "edge").exists()


def test_files_of_an_opc_ua_drive_are_looked_for_where_the_edge_runs(tmp_path: Path) -> None:
    drive = {"kind": "opcua", "url": "opc.tcp://plc", "certificate": "plc.der"}
    assert enrolled(tmp_path, "two-mass-drive", drive=drive).drive == drive


def test_an_edge_whose_rate_makes_the_loop_unstable_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="at 100 Hz is unstable on this axis even without a gap"):
        enrolled(tmp_path, "ball-screw", role="control", sample_rate=100.0)
    assert not (tmp_path / "edge").exists()


@pytest.mark.parametrize("rate", [0.0, -5.0])
def test_a_rate_that_is_none_is_refused(tmp_path: Path, rate: float) -> None:
    with pytest.raises(InvalidInput, match=f"sample_rate = {rate!r} Hz: must be a positive number"):
        enrolled(tmp_path, "ball-screw", role="control", sample_rate=rate)


@pytest.mark.parametrize(("rate", "role"), [(2000.0, "control"), (500.0, "supervise"), (None, "control")])
def test_a_law_with_discrete_matrices_runs_at_their_rate(tmp_path: Path, rate: float | None, role: str) -> None:
    drive = Axis.preset("two-mass-drive")
    law = LinearLaw(
        A=((-50.0,),), B=((1.0, 0.0, -1.0),), C=(-47000.0,), D=(1060.0, 0.0, -1060.0), sample_rate=1000.0
    ).held()
    (tmp_path / "own.toml").write_text(drive.replace(controller=law).dumps())
    if rate == 2000.0:
        with pytest.raises(InvalidInput, match=r"sample_rate_hz = 2000.0 Hz: .* matrices for 1000.0 Hz; give that"):
            enrolled(tmp_path, "own.toml", role=role, sample_rate=rate)
        assert not (tmp_path / "edge").exists()
        return
    config = enrolled(tmp_path, "own.toml", role=role, sample_rate=rate)
    assert config.controller is not None
    assert config.controller.sample_rate == 1000.0


UNITS = {
    "two-mass-drive": ("N m", "rad"),
    "ball-screw": ("N m", "m"),
    "robot-joint": ("N m", "rad"),
    "stepper-stage": ("rad", "m"),
    "paper": ("V", "m"),
}


@pytest.mark.parametrize(("name", "units"), UNITS.items())
def test_the_edge_s_file_counts_in_the_units_of_its_machine(tmp_path: Path, name: str, units: tuple[str, str]) -> None:
    config = enrolled(tmp_path, name)
    text = (tmp_path / "edge" / "edge.toml").read_text()
    assert (config.command_unit, config.position_unit) == units
    keys = [line.partition(" = ")[0] for line in text.splitlines() if " = " in line]
    said = {unit_of(key).si for key in keys}
    assert ("m" in said, "m/s" in said) == (units[1] == "m", units[1] == "m")
    assert ("V" in said) == (units[0] == "V")
    assert ("command_unit" in text) == (units != ("V", "m"))
    schema = json.loads(texts()["schemas/edge.json"])
    jsonschema_rs.validate(schema, tomllib.loads(text.replace("= inf", "= 1e300")))
    assert read_config(parse_toml(edge_toml(config), "edge.toml")) == config


def test_an_edge_s_file_refuses_a_key_in_another_unit(tmp_path: Path) -> None:
    enrolled(tmp_path, "robot-joint")
    file = tmp_path / "edge" / "edge.toml"
    text = file.read_text()
    file.write_text(text.replace("maximum_rad = ", "maximum_mm = "))
    with pytest.raises(
        InvalidInput, match=r"'limits.maximum_mm': .* counts it in rad; here its name is 'limits.maximum_d"
    ):
        load(file)
    file.write_text(text.replace("maximum_rad = inf", "maximum_deg = 45.0"))
    assert load(file).agent.limits.maximum == pytest.approx(math.pi / 4.0, abs=0.0)


@pytest.mark.parametrize(
    ("name", "noise", "words"),
    [
        ("robot-joint", StatedNoise(2.0), r"noise_um = 2.0: this servo's position needs noise_mdeg"),
        ("ball-screw", StatedNoise(2.0, "mdeg"), r"noise_mdeg = 2.0: this servo's position needs noise_um"),
        ("robot-joint", StatedNoise(2.0, "mdeg"), ""),
        ("ball-screw", StatedNoise(2.0), ""),
    ],
)
def test_noise_is_stated_in_the_unit_of_the_position(tmp_path: Path, name: str, noise: StatedNoise, words: str) -> None:
    if not words:
        assert enrolled(tmp_path, name, noise=noise).agent.servo == "ax-1"
        return
    with pytest.raises(InvalidInput, match=words):
        enrolled(tmp_path, name, noise=noise)
