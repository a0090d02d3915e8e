"""An edge whose motor has no encoder: it neither records nor sends an angle."""

from array import array
from dataclasses import replace
from pathlib import Path

import pytest
from sending_agent import SendingAgent

from servotwin.config.table import Table
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.drives.replay import Replay
from servotwin.drives.table import supervised_drive
from servotwin.edge.outlet import recorded_channels
from servotwin.edge.settings import AgentSettings
from servotwin.edge_process.config import UNBOOTED, EdgeConfig
from servotwin.errors import InvalidInput
from servotwin.messages import WindowMessage, unpack_channel
from servotwin.twin.estimating import decode_window

NAN = float("nan")
LAW = Controller(200.0, 0.0, 0.0, 0.1, sample_rate=100.0)
AGENT = AgentSettings("axis-1", UNBOOTED, 100.0, 0.5, motor_encoder=False)


def sent(one_by_one: bool) -> WindowMessage:
    agent = SendingAgent(replace(AGENT, boot="b0"))
    signals = [[1e-3] * 50, [NAN] * 50, [1e-5 * k for k in range(50)], [0.1 + 1e-7 * k * k for k in range(50)]]
    if one_by_one:
        letters = [out for sample in zip(*signals, strict=True) for out in agent.absorb(*sample)]
    else:
        letters = agent.absorb_block(*(array("d", signal) for signal in signals))
    (window,) = (out.message for out in letters if isinstance(out.message, WindowMessage))
    return window


@pytest.mark.parametrize("one_by_one", [False, True])
def test_its_windows_have_no_angle_and_the_command_finely(one_by_one: bool) -> None:
    window = sent(one_by_one)
    assert [each.name for each in window.channels] == ["reference", "position", "voltage", "voltage_fine"]
    coarse = [abs(a - (0.1 + 1e-7 * k * k)) for k, a in enumerate(unpack_channel(window.channels[2]))]
    decoded = decode_window(window)
    assert decoded.theta_m is None
    fine = [abs(a - (0.1 + 1e-7 * k * k)) for k, a in enumerate(decoded.voltage)]
    assert max(coarse) > 1e-10
    assert max(fine) < 1e-13


def test_the_shared_samples_have_the_channels_that_are_measured() -> None:
    assert recorded_channels(motor_encoder=True) == ("reference", "theta_m", "position", "voltage")
    assert recorded_channels(motor_encoder=False) == ("reference", "position", "voltage")


def test_a_law_that_reads_the_motor_is_refused() -> None:
    config = EdgeConfig(AGENT, "control", LAW, {"kind": "simulated"})
    cascade = Cascade(20.0, 0.1, velocity_gain=3.0, sample_rate=100.0)
    with pytest.raises(InvalidInput, match="motor_encoder = false: the controller reads y_motor"):
        replace(config, controller=cascade)
    replace(config, controller=replace(cascade, velocity_gain=None))  # a drive in velocity mode


def log_of(folder: Path) -> Path:
    path = folder / "log.csv"
    rows = "".join(f"{0.01 * k:.12g},{1e-3 * k:.12g},0.0,{0.5 * k:.12g}\n" for k in range(100))
    path.write_text(f"time_s,measured_position_m,reference_m,command_rad_per_s\n{rows}", encoding="utf-8")
    return path


def test_a_log_without_the_motors_angle_is_replayed_for_it_only(tmp_path: Path) -> None:
    log_of(tmp_path)
    table = Table("edge.toml", {"kind": "replay", "log": "log.csv", "speed": 0.0}, "drive")
    with pytest.raises(InvalidInput, match=r"log.csv: column .*theta_m_rad.* is missing; .*motor_encoder = false"):
        supervised_drive(table, tmp_path)
    drive = supervised_drive(table, tmp_path, motor_encoder=False)
    assert isinstance(drive, Replay)
    drive.connect()
    block = drive.read(10)
    drive.close()
    assert block is not None
    assert list(block.position) == pytest.approx([1e-3 * k for k in range(10)])
    assert all(angle != angle for angle in block.theta_m)


def test_a_log_whose_columns_are_in_other_units_than_the_edge_is_refused(tmp_path: Path) -> None:
    """The motor's angle follows from the command: volts in place of rad/s would make another one of it."""
    log_of(tmp_path)
    config = EdgeConfig(
        AGENT, "supervise", None, {"kind": "replay", "log": "log.csv"}, command_unit="rad/s", folder=tmp_path
    )
    supervised_drive(config.drive_table, tmp_path, motor_encoder=False)
    volts = r'edge.toml: drive.log = .*log.csv: column command_rad_per_s is in rad/s, and command_unit = "V"'
    with pytest.raises(InvalidInput, match=volts):
        supervised_drive(replace(config, command_unit="V").drive_table, tmp_path, motor_encoder=False)
    rotary = r'column measured_position_m is in m, and position_unit = "rad"'
    with pytest.raises(InvalidInput, match=rotary):
        supervised_drive(replace(config, position_unit="rad").drive_table, tmp_path, motor_encoder=False)
