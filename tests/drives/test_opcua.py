"""The OPC UA drive against a real server with a simulated machine behind it."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from machines import plant_file
from numpy.typing import NDArray
from selfsigned import self_made

from servotwin.config.table import Table
from servotwin.control.gains import gains_of
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.drives.opcua.drive import OpcUaDrive
from servotwin.drives.opcua.settings import OpcUaSettings
from servotwin.drives.table import control_drive, supervised_drive
from servotwin.edge.drive import Block, DriveLost, DriveRefused
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput
from servotwin.messages import Setting
from servotwin.simulation import Run, Simulation

pytestmark = pytest.mark.skipif(find_spec("asyncua") is None, reason="the extra opcua is not installed")

SERVER = Path(__file__).parents[1] / "support" / "opcua_machine.py"
CHANNELS = ("reference", "theta_m", "position", "voltage")
SIMULATED = 25.0  # s, more than any of these tests runs
LONG = 20_000  # samples, 4 s: a ring that a busy machine does not outrun


def free_url() -> str:
    with socket.create_server(("127.0.0.1", 0)) as trial:
        return f"opc.tcp://127.0.0.1:{trial.getsockname()[1]}/servo"


@contextmanager
def server(folder: Path, **options: Any) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A running server: its URL and its process, killed in the end."""
    plant = plant_file(folder, "supervise", SIMULATED, endless=True, block_s=0.05)
    arguments = {"plant": str(plant), "url": free_url(), **options}
    process = subprocess.Popen(
        [sys.executable, str(SERVER), json.dumps(arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline().startswith("ready")
        yield arguments["url"], process
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()


def drive_at(url: str, **changes: Any) -> OpcUaDrive:
    return OpcUaDrive(OpcUaSettings(url, **{"poll_s": 0.03, "silence_s": 10.0, **changes}))


def joined(blocks: list[Block]) -> NDArray[np.float64]:
    return np.concatenate([np.array([getattr(block, name) for name in CHANNELS]) for block in blocks], axis=1)


def whole(simulation: Simulation) -> Run:
    simulation.advance(simulation.samples - 1)
    return simulation.run()


def same(blocks: list[Block], run: Run) -> bool:
    numbers = np.concatenate([np.arange(block.first, block.last) for block in blocks])
    return all(
        np.array_equal(seen, run.measured(name)[numbers]) for seen, name in zip(joined(blocks), CHANNELS, strict=True)
    )


@pytest.mark.slow
def test_samples_and_changes_are_the_simulation_s(tmp_path: Path) -> None:
    with server(tmp_path, ring=LONG) as (url, _), closing(drive_at(url)) as drive:
        scenario = Scenario.load(tmp_path / "scenario.toml")
        softer = scenario.start_law.replace(
            Kp=1000.0,
            Ki=9000.0,
            leave=1.3,
            velocity_feedforward=150.0,
            velocity_time=0.05,
            friction_feedforward=0.02,
            notch_hz=4.0,
        )
        drive.connect()
        blocks = [drive.read(), drive.read(37)]
        drive.write(Parameters(5, Setting(3e-5, gains_of(softer))))
        blocks += [drive.read(1000) for _ in range(6)]
        with pytest.raises(DriveRefused, match="tolerance"):
            drive.write(_unchecked(Parameters(6), setting=Setting(-1.0)))
        drive.write(Parameters(7, Setting(2e-5)))
        blocks += [drive.read(1000) for _ in range(6)]
        assert drive.rate == 5000.0
        assert not drive.can_move
        with closing(drive_at(url, node="Axis")) as nowhere, pytest.raises(InvalidInput, match="BadNoMatch"):
            nowhere.connect()
    since = {version: next(b.first for b in blocks if b.version == version) for version in (5, 7)}
    simulation = simulation_of(scenario)
    simulation.advance(since[5])
    simulation.set_controller(softer, 3e-5)
    simulation.advance(since[7])
    simulation.set_tolerance(2e-5)
    assert [block.version for block in blocks] == sorted(block.version for block in blocks)
    assert [block.first for block in blocks[1:]] == [block.last for block in blocks[:-1]]
    assert len(blocks[1].position) == 37
    assert same(blocks, whole(simulation))


@pytest.mark.slow
def test_a_server_that_hangs_is_the_same_machine_and_a_restarted_one_another(tmp_path: Path) -> None:
    url = free_url()
    with server(tmp_path, url=url, ring=LONG) as (_, process), closing(drive_at(url, silence_s=1.0)) as drive:
        drive.connect()
        name, blocks = drive.machine, [drive.read()]
        os.killpg(process.pid, signal.SIGSTOP)
        _read_until_lost(drive, blocks)
        with pytest.raises(DriveLost):
            drive.connect()
        with pytest.raises(DriveLost, match="not connected"):
            drive.read()
        os.killpg(process.pid, signal.SIGCONT)
        _connect(drive)
        blocks.append(drive.read())
        assert drive.machine == name
        assert [block.first for block in blocks[1:]] == [block.last for block in blocks[:-1]]
    with closing(drive):
        _read_until_lost(drive, [])
        with server(tmp_path, url=url, ring=500, speed=2.0):
            _connect(drive)
            assert drive.machine != name
            assert drive.read().version == 0
            _check_that_overwritten_samples_are_missing(drive, Scenario.load(tmp_path / "scenario.toml"))


class Guarded(NamedTuple):
    """A server with a password and a certificate, whose machine has no feedforwards; how a drive is let in."""

    folder: Path
    url: str
    secured: dict[str, Any]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    folder = tmp_path_factory.mktemp("guarded")
    mine, key = _certificate(folder, "one")
    files = {"certificate": str(mine), "private_key": str(key)}
    with server(folder, optional=False, user="edge", password="secret", **files) as (url, _):
        yield Guarded(
            folder, url, {"user": "edge", "certificate": mine, "private_key": key, "server_certificate": mine}
        )


@pytest.mark.slow
def test_a_drive_without_feedforwards_refuses_them_and_takes_other_gains(guarded: Guarded) -> None:
    with closing(drive_at(guarded.url, password="secret", **guarded.secured)) as drive:
        drive.connect()
        law = Scenario.load(guarded.folder / "scenario.toml").start_law
        with pytest.raises(DriveRefused, match="VelocityFeedforward"):
            drive.write(Parameters(5, Setting(3e-5, gains_of(law.replace(velocity_feedforward=150.0)))))
        with pytest.raises(DriveRefused, match="FrictionFeedforward"):
            drive.write(Parameters(5, Setting(3e-5, gains_of(law.replace(friction_feedforward=0.02)))))
        with pytest.raises(DriveRefused, match="NotchHz"):
            drive.write(Parameters(5, Setting(3e-5, gains_of(law.replace(notch_hz=4.0)))))
        with pytest.raises(DriveRefused, match="IntegralOnly"):
            drive.write(Parameters(5, Setting(3e-5, gains_of(law.replace(integral_only=True)))))
        drive.write(Parameters(6, Setting(3e-5, gains_of(law))))


@pytest.mark.slow
def test_passwords_and_certificates(guarded: Guarded, tmp_path: Path) -> None:
    other, _ = _certificate(tmp_path, "two")
    with closing(drive_at(guarded.url, password="secret", **guarded.secured)) as drive:
        drive.connect()
        drive.write(Parameters(7, Setting(1e-5)))
        while drive.read().version != 7:
            pass
    for wrong in ({"password": "guessed"}, {"password": "secret", "server_certificate": other}):
        with closing(drive_at(guarded.url, **{**guarded.secured, **wrong}, silence_s=3.0)) as drive:
            with pytest.raises((InvalidInput, DriveLost)) as error:
                drive.connect()
            assert "guessed" not in str(error.value)
            assert "secret" not in str(error.value)
    with closing(drive_at(guarded.url, silence_s=3.0)) as drive, pytest.raises((InvalidInput, DriveLost)):
        drive.connect()


@pytest.mark.slow
def test_a_server_that_is_not_there() -> None:
    with closing(drive_at(free_url(), silence_s=1.0)) as drive, pytest.raises(DriveLost):
        drive.connect()


def test_without_asyncua_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "asyncua", None)
    with pytest.raises(InvalidInput, match=r"pip install 'servotwin\[opcua\]'"):
        drive_at("opc.tcp://127.0.0.1:4840").connect()


URL = "opc.tcp://127.0.0.1:4840"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"url": "http://127.0.0.1"}, "url = 'http://127.0.0.1' is not allowed"),
        ({"url": "opc.tcp://user:word@127.0.0.1"}, "is not allowed"),
        ({"url": "opc.tcp://plc.example:4840"}, "beyond this machine certificate"),
        ({"url": URL, "user": "edge"}, "both are needed, or neither"),
        ({"url": URL, "certificate": "made.pem"}, "all of them are needed, or none"),
        ({"url": URL, "certificate": "open.txt"}, "open.txt: holds no certificate; give NAME.pem in PEM, or"),
        ({"url": URL, "user": "edge", "password_file": "open.txt"}, "make it 0600"),
        ({"url": URL, "user": "edge", "password_file": "none.txt"}, "none.txt: cannot be read"),
        ({"url": URL, "user": "edge", "password_env": "NOT_THERE"}, "environment variable NOT_THERE: is empty"),
        ({"url": URL, "password": "secret"}, "unknown key 'drive.password'"),
        ({"url": URL, "poll_s": 0.0}, "poll_s = 0.0 is not allowed"),
    ],
)
def test_an_error_in_the_drive_table_is_named(tmp_path: Path, values: dict[str, object], message: str) -> None:
    (tmp_path / "open.txt").write_text("secret")
    self_made(tmp_path)[0].rename(tmp_path / "made.pem")
    (tmp_path / "open.txt").chmod(0o644)
    with pytest.raises(InvalidInput) as error:
        supervised_drive(Table("edge.toml", {"kind": "opcua", **values}, "drive"), tmp_path)
    assert message in str(error.value)
    assert str(error.value).startswith("edge.toml")


def test_the_table_of_each_kind(tmp_path: Path) -> None:
    (tmp_path / "word.txt").write_text("secret\n")
    (tmp_path / "word.txt").chmod(0o600)
    (tmp_path / "run.csv").write_text("time_s,reference_m,theta_m_rad,position_m,voltage_v\n0,0,0,0,0\n")
    tables = (
        {"kind": "opcua", "url": URL, "user": "edge", "password_file": "word.txt"},
        {"kind": "replay", "log": "run.csv", "speed": 0.0},
        {"kind": "simulated", "address": "unix:machine.sock"},
    )
    for values in tables:
        supervised_drive(Table("edge.toml", values, "drive"), tmp_path).close()
    control_drive(Table("edge.toml", tables[2], "drive"), tmp_path).close()
    with pytest.raises(InvalidInput, match=r"drive\.kind = 'replay' is not allowed; give one of simulated"):
        control_drive(Table("edge.toml", tables[1], "drive"), tmp_path)


def _check_that_overwritten_samples_are_missing(drive: OpcUaDrive, scenario: Scenario) -> None:
    """And never old ones, on a machine whose ring holds less than is read at a time."""
    blocks, holes = [drive.read()], 0
    for _ in range(50):
        time.sleep(0.05)
        blocks.append(drive.read())
        holes += blocks[-1].first > blocks[-2].last
        assert blocks[-1].first >= blocks[-2].last
        if holes > 2:
            break
    assert holes > 2
    assert same(blocks, whole(simulation_of(scenario)))


def _unchecked(parameters: Parameters, **changes: Any) -> Parameters:
    for name, value in changes.items():
        object.__setattr__(parameters, name, value)
    return parameters


def _read_until_lost(drive: OpcUaDrive, blocks: list[Block]) -> None:
    """Read on until the drive is lost, which must come; what was read before that is kept."""
    with pytest.raises(DriveLost):
        blocks.extend(drive.read() for _ in range(100))


def _connect(drive: OpcUaDrive) -> None:
    """As an edge does: until it is there."""
    for _ in range(50):
        try:
            drive.connect()
        except DriveLost:
            time.sleep(0.1)
        else:
            return
    pytest.fail("the server did not come back")


def _certificate(folder: Path, name: str) -> tuple[Path, Path]:
    """A self-signed certificate and its key, for client and server alike."""
    from asyncua.crypto.cert_gen import (
        dump_private_key_as_pem,
        generate_private_key,
        generate_self_signed_app_certificate,
    )
    from cryptography.hazmat.primitives.serialization import Encoding
    from cryptography.x509 import UniformResourceIdentifier
    from cryptography.x509.oid import ExtendedKeyUsageOID

    key = generate_private_key()
    usage = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
    names = [UniformResourceIdentifier("urn:servotwin:test")]
    certificate = generate_self_signed_app_certificate(key, name, {"commonName": name}, names, extended=usage, days=2)
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(Encoding.PEM))
    (folder / f"{name}-key.pem").write_bytes(dump_private_key_as_pem(key))
    return folder / f"{name}.pem", folder / f"{name}-key.pem"
