"""A log replayed: its samples as they are, at their pace, and the errors in it that are raised before it begins."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from servotwin.cli.simulate import convert
from servotwin.drives.replay import Replay
from servotwin.edge.drive import Block, DriveLost
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput
from servotwin.logs.columns import SignalTable
from servotwin.logs.log import write_log
from servotwin.messages import Setting
from servotwin.plant.axis import Axis
from servotwin.simulation import simulate

HEAD = "time_s,position_m,voltage_v,measured_position_m,reference_m,theta_m_rad"


class Time:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """100 samples at 1 kHz, each number its own."""
    rows = np.arange(600.0).reshape(100, 6)
    rows[:, 0] = 5.0 + np.arange(100) / 1000.0
    path = tmp_path / "log.csv"
    text = "\n".join(",".join(f"{value:.12g}" for value in row) for row in rows)
    path.write_text(f'# {{"servo": "paper"}}\n{HEAD}\n{text}\n')
    return path


def signals(blocks: list[Block]) -> NDArray[np.float64]:
    return np.concatenate([np.array([b.reference, b.theta_m, b.position, b.voltage]) for b in blocks], axis=1)


def read_all(drive: Replay, most: int = 0) -> list[Block]:
    blocks = []
    while (block := drive.read(most)) is not None:
        blocks.append(block)
    return blocks


def test_samples_come_as_they_are_and_the_measured_position_goes_first(log: Path) -> None:
    with closing(Replay(log, speed=0.0)) as drive:
        drive.connect()
        blocks = read_all(drive, 30)
    assert drive.rate == 1000.0
    assert [(block.first, block.last) for block in blocks] == [(0, 30), (30, 60), (60, 90), (90, 100)]
    columns = np.arange(600.0).reshape(100, 6).T
    assert np.array_equal(signals(blocks), columns[[4, 5, 3, 2]])


@pytest.mark.parametrize("speed", [1.0, 8.0])
def test_a_block_comes_when_its_last_sample_is_due(log: Path, speed: float) -> None:
    time = Time()
    with closing(Replay(log, speed, block_s=0.02, clock=time.clock, sleep=time.sleep)) as drive:
        drive.connect()
        due = []
        while drive.read() is not None:
            due.append((time.now - 100.0) * speed)
    assert due == pytest.approx([0.02, 0.04, 0.06, 0.08, 0.1])


def test_a_loop_leaves_out_one_number_at_its_seam(log: Path) -> None:
    with closing(Replay(log, speed=0.0, loop=True)) as drive:
        drive.connect()
        blocks = [drive.read(64) for _ in range(5)]
    assert [(block.first, block.last) for block in blocks] == [(0, 64), (64, 100), (101, 165), (165, 201), (202, 266)]
    assert blocks[2].position == blocks[0].position


def test_parameters_are_recorded_and_change_nothing(log: Path) -> None:
    with closing(Replay(log, speed=0.0)) as drive:
        drive.connect()
        before, parameters = drive.read(10), Parameters(4, Setting(1e-4))
        drive.write(parameters)
        drive.move(1e-3)
        after = drive.read(10)
        assert (before.version, after.version) == (0, 4)
        assert after.reference[0] == 64.0
        assert list(drive.written) == [(10, parameters)]
        assert not drive.can_move


@pytest.mark.parametrize("preset", ["telescope", "gantry", "stepper-stage"])
def test_a_log_of_an_axis_comes_in_its_own_units(tmp_path: Path, preset: str) -> None:
    """Rotary or linear, with any command: as `servotwin simulate` writes it."""
    axis = Axis.preset(preset)
    run = simulate(axis, 0.1, reference=1e-4, gap=1e-3, sample_rate=1000.0)
    write_log(SignalTable(run.columns, {}), tmp_path / "run.csv")
    with closing(Replay(tmp_path / "run.csv", speed=0.0)) as drive:
        drive.connect()
        seen = signals(read_all(drive))
    written = np.array([run.reference, run.measured_theta_m, run.measured_position, run.voltage])
    assert seen == pytest.approx(written, rel=1e-9, abs=0.0)


def test_degrees_and_millimetres_are_converted_and_never_mixed(log: Path) -> None:
    text = log.read_text()
    log.write_text(text.replace("theta_m_rad", "theta_m_deg").replace("d_position_m", "d_position_mm"))
    with closing(Replay(log, speed=0.0)) as drive:
        drive.connect()
        block = drive.read(2)
    assert block is not None
    assert (block.theta_m[0], block.position[1]) == (np.radians(5.0), pytest.approx(9e-3))
    log.write_text(text.replace("reference_m", "reference_deg"))
    with pytest.raises(InvalidInput, match="measured_position_m and reference_deg: must both be lengths or both be"):
        Replay(log).connect()


def test_an_npz_is_converted_first(log: Path, tmp_path: Path) -> None:
    packed, again = tmp_path / "log.npz", tmp_path / "again.csv"
    convert(log, packed)
    with pytest.raises(InvalidInput, match=r"give a \.csv, for example by servotwin convert .*log\.npz"):
        Replay(packed).connect()
    convert(packed, again)
    blocks = []
    for path in (log, again):
        with closing(Replay(path, speed=0.0)) as drive:
            drive.connect()
            blocks.append(drive.read(100))
    assert blocks[0] == blocks[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("theta_m_rad", "theta"), "theta_m_rad or theta_m_deg is missing; it has time_s, position_m"),
        (("5.05,", "5.0512,"), r"time_s = 5\.0512 s at sample 50: must be increasing, uniformly spaced"),
        ((",302,", ",nan,"), "line 53 must hold finite numbers"),
        ((",302,", ",,"), "line 53 must hold finite numbers"),
        (("\n5.099,", "\n5.099;"), "line 102 must hold finite numbers"),
    ],
)
def test_an_error_in_a_log_is_raised_before_the_replay_begins(log: Path, change: tuple[str, str], message: str) -> None:
    text = log.read_text()
    assert change[0] in text
    log.write_text(text.replace(*change))
    drive = Replay(log)
    with pytest.raises(InvalidInput, match=message):
        drive.connect()
    with pytest.raises(DriveLost, match="not connected"):
        drive.read()


@pytest.mark.parametrize("text", ["", "# {}\n", f"{HEAD}\n", f"{HEAD}\n0,1,2,3,4,5\n"])
def test_a_log_without_samples_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "short.csv"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"is missing|at least 2 are needed"):
        Replay(path).connect()


def test_a_log_that_is_missing_or_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with pytest.raises(InvalidInput, match="cannot be read"):
        Replay(path).connect()
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidInput, match="is not a text file"):
        Replay(path).connect()
