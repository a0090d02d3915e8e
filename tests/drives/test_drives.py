"""The simulated drive: a process that is the simulation bit for bit, in both roles; and its clients."""

import signal
import socket
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from machines import machine, plant_file, served
from numpy.typing import NDArray

from servotwin.control import law
from servotwin.control.gains import gains_of
from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.drives.simulated import wire
from servotwin.drives.simulated.client import SimulatedControl, SimulatedSupervised
from servotwin.drives.simulated.plants import ControlledPlant, SupervisedPlant
from servotwin.drives.simulated.server import listening
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.edge.drive import Block, ControlDrive, DriveLost, DriveRefused, DriveSample, SupervisedDrive
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput
from servotwin.messages import Gains, Setting
from servotwin.simulation import Run, Simulation

CHANNELS = ("reference", "theta_m", "position", "voltage")
SOFTER = {"Kp": 1000.0, "Ki": 9000.0, "leave": 1.4, "feedforward": 0.02}


def whole(simulation: Simulation) -> Run:
    simulation.advance(simulation.samples - 1)
    return simulation.run()


def joined(blocks: list[Block]) -> NDArray[np.float64]:
    return np.concatenate([np.array([getattr(block, name) for name in CHANNELS]) for block in blocks], axis=1)


def read_all(drive: SupervisedDrive, most: int) -> list[Block]:
    blocks: list[Block] = []
    while (block := drive.read(most)) is not None:
        blocks.append(block)
    return blocks


@pytest.mark.slow
def test_control_ticked_through_the_socket_is_the_sampled_simulation(tmp_path: Path) -> None:
    """4 s at 5 kHz with noise, a dead zone and a gap that grows from nothing, contacts inside samples included."""
    path = plant_file(tmp_path, "control", 4.0)
    scenario = Scenario.load(tmp_path / "scenario.toml")
    run = whole(simulation_of(scenario))
    parameters, state = scenario.start_law.law(scenario.start_tolerance), law.start(0.0)
    rows = []
    with machine(path) as (address, process), closing(SimulatedControl(address)) as drive:
        drive.connect()
        while (sample := drive.read()) is not None:
            state = law.tick(parameters, state, sample.reference, sample.position)
            drive.write(state.voltage)
            rows.append((*sample, state.voltage))
        assert process.wait(10) == 0
    seen = np.array(rows).T
    assert seen.shape[1] == run.samples - 1
    assert (seen[0] == np.arange(run.samples - 1)).all()
    for values, name in zip(seen[1:], CHANNELS, strict=True):
        assert np.array_equal(values, run.measured(name)[:-1]), name
    assert {"contact", "release", "enter", "leave"} <= set(run.events.kind)


@pytest.mark.slow
def test_supervise_is_the_simulation_with_the_same_changes_at_the_same_samples(tmp_path: Path) -> None:
    path = plant_file(tmp_path, "supervise", 5.0)
    scenario = Scenario.load(tmp_path / "scenario.toml")
    controller = scenario.start_law.replace(**SOFTER)
    with served(path) as address, closing(SimulatedSupervised(address)) as drive:
        drive.connect()
        before = [drive.read(2345), drive.read(10_000)]
        changed = before[-1].last
        drive.write(Parameters(7, Setting(2e-5, gains_of(controller))))
        between = [drive.read(1500)]
        moved = between[-1].last
        drive.move(2e-4)
        after = read_all(drive, 4000)
    same = simulation_of(scenario)
    same.advance(changed)
    same.set_controller(controller, 2e-5)
    same.advance(moved)
    same.move(2e-4)
    run, blocks = whole(same), before + between + after
    assert changed == 2345 + wire.MAX_SAMPLES
    assert [block.version for block in blocks] == [0, 0] + [7] * (len(blocks) - 2)
    assert [block.first for block in blocks[1:]] == [block.last for block in blocks[:-1]]
    for values, name in zip(joined(blocks), CHANNELS, strict=True):
        assert np.array_equal(values, run.measured(name)[:-1]), name


@pytest.mark.slow
def test_a_dead_zone_is_set_as_it_is_and_parameters_of_no_controller_change_nothing(tmp_path: Path) -> None:
    gains = Gains(1.0, 2.0, 3.0, 0.1)
    path = plant_file(tmp_path, "supervise", 4.0)
    with served(path) as address, closing(SimulatedSupervised(address)) as drive:
        drive.connect()
        blocks = [drive.read(2990)]
        for bad in (-1.0, np.inf):
            refused = Parameters(3, Setting(0.0, gains))
            object.__setattr__(refused, "setting", Setting(bad, gains))
            with pytest.raises(DriveRefused, match="tolerance"):
                drive.write(refused)
        blocks += [drive.read(10)]
        assert blocks[-1].version == 0
        drive.write(Parameters(1, Setting(1e-4)))
        blocks += read_all(drive, 3000)
    same = simulation_of(Scenario.load(tmp_path / "scenario.toml"))
    same.advance(3000)
    same.set_tolerance(1e-4)
    assert np.array_equal(joined(blocks)[3], whole(same).voltage[:-1])


@pytest.mark.slow
def test_a_killed_edge_reconnects_to_the_running_machine(tmp_path: Path) -> None:
    """In supervise nothing is missing either, as long as the machine keeps it."""
    path = plant_file(tmp_path, "supervise", speed=20.0, endless=True)
    with served(path) as address, closing(SimulatedSupervised(address)) as drive:
        drive.connect()
        first, name = drive.read(), drive.machine
        drive.close()
        with pytest.raises(DriveLost):
            drive.read()
        drive.connect()
        assert drive.machine == name
        assert drive.read().first == first.last
        with closing(SimulatedSupervised(address)) as another:
            drive.close()
            another.connect()
            assert another.machine == name
            assert another.read().first > first.last


@pytest.mark.slow
def test_a_paced_machine_runs_on_without_its_edge(tmp_path: Path) -> None:
    path = plant_file(tmp_path, "control", speed=5.0, endless=True)
    with served(path) as address, closing(SimulatedControl(address)) as drive:
        drive.connect()
        numbers = [_ticked(drive).number for _ in range(200)]
        assert numbers == list(range(numbers[0], numbers[0] + 200))
        drive.close()
        drive.connect()
        assert _ticked(drive).number >= numbers[-1] + 1


@pytest.mark.slow
def test_an_edge_that_sleeps_misses_its_ticks(tmp_path: Path) -> None:
    """Beyond the slack the machine does not wait: the next number says how many samples are missing."""
    path = plant_file(tmp_path, "control", speed=5.0, endless=True, slack_s=0.02)
    with served(path) as address, closing(SimulatedControl(address)) as drive:
        drive.connect()
        first = drive.read()
        found = first
        for _ in range(200):  # until the machine has had its turn
            signal.sigtimedwait([], 0.05)
            drive.write(0.0)
            found = drive.read()
            if found.number > first.number + 100:
                break
        assert found.number > first.number + 100
        assert 0.0 <= drive.lag <= 0.02 * 5.0 + 1e-9


@pytest.mark.slow
def test_a_voltage_that_is_no_number_lets_the_last_one_hold(tmp_path: Path) -> None:
    with served(plant_file(tmp_path, "control", 1.0)) as address, closing(SimulatedControl(address)) as drive:
        drive.connect()
        positions = []
        for voltage in (0.5, np.nan, np.inf, None):
            positions.append(drive.read().theta_m)
            if voltage is not None:
                drive.write(voltage)
        positions.append(drive.read().theta_m)
    assert positions[0] == 0.0
    assert all(np.diff(positions) > 0.0)


@pytest.mark.slow
def test_wrong_roles_protocols_and_missing_machines_are_refused(tmp_path: Path) -> None:
    with machine(plant_file(tmp_path, "control", 1.0, listen="unix:here.sock")) as (address, process):
        assert address == f"unix:{tmp_path / 'here.sock'}"
        assert (tmp_path / "here.sock").stat().st_mode & 0o777 == 0o600
        for drive in (SimulatedSupervised(address), SimulatedSupervised(address)):
            with pytest.raises(InvalidInput, match="role supervise in protocol 5"):
                drive.connect()
        with closing(SimulatedControl(address, silence=0.2)) as first, closing(SimulatedControl(address, 0.2)) as other:
            first.connect()
            assert first.read().number == 0
            with pytest.raises(DriveLost, match=r"silent for 0\.2 s"):
                other.connect()
            process.kill()
            process.wait()
            with pytest.raises(DriveLost):
                first.read()
        with pytest.raises(DriveLost):
            other.connect()
    with machine(plant_file(tmp_path, "control", 1.0, listen="unix:here.sock")) as (address, process):
        process.send_signal(signal.SIGTERM)  # the left-over path was no obstacle
        assert process.wait(10) == 0
        assert not (tmp_path / "here.sock").exists()


@pytest.mark.slow
def test_rubbish_from_a_client_ends_that_client_only(tmp_path: Path) -> None:
    with served(plant_file(tmp_path, "supervise", 1.0)) as address:
        for rubbish in (b"", b"GET / HTTP/1.1\r\n\r\n", wire.HELLO.pack(wire.MAGIC, 99, wire.SUPERVISE)):
            host, port = address.split(":")
            with socket.create_connection((host, int(port))) as line:
                line.sendall(rubbish)
        with closing(SimulatedSupervised(address)) as drive:
            drive.connect()
            drive._connection.send(b"\xff" * wire.REQUEST.size)
            assert wire.REPLY.unpack(drive._connection.receive(wire.REPLY.size))[0] == wire.REFUSED
            drive.close()
            drive.connect()
            assert len(drive.read(5).position) == 5


def test_without_its_edge_the_voltage_holds_until_the_watchdog_takes_it_away(tmp_path: Path) -> None:
    path = plant_file(tmp_path, "control", endless=True, watchdog_s=0.01)
    alone, attended = (ControlledPlant(MachineSettings.load(path)) for _ in range(2))
    for plant in (alone, attended):
        plant.tick(0.7)
    for sample in range(200):
        alone.run_alone()
        attended.tick(0.7 if sample < 50 else 0.0)
        assert alone.sample() == attended.sample()
    assert (alone.index, alone.over) == (201, False)


def test_samples_wait_for_their_reader_for_a_limited_time(tmp_path: Path) -> None:
    plant = SupervisedPlant(MachineSettings.load(plant_file(tmp_path, "supervise", 1.0, keep_s=0.1)))
    for _ in range(19):
        plant.advance(250)
    plant.write(4, 1e-5, None)
    assert plant.read(4200, 10).first == 4250
    assert plant.read(4300, 10).values.shape == (4, 10)
    assert plant.read(4750, 10) is None
    plant.advance(1000)
    assert (plant.index, plant.over) == (4999 + 1, True)
    assert (plant.read(4750, 10).version, plant.read(4749, 10).version) == (4, 0)
    assert plant.read(5000, 1) is None


def test_the_clients_need_neither_numpy_nor_asyncua(tmp_path: Path) -> None:
    program = """
import sys
for name in ("numpy", "scipy", "numba", "asyncua", "typer", "rich"):
    sys.modules[name] = None
from servotwin.drives.table import control_drive, supervised_drive
from servotwin.drives.opcua.drive import OpcUaDrive
from servotwin.config.table import Table
from pathlib import Path
Path("x.csv").write_text("time_s,reference_m,theta_m_rad,position_m,voltage_v\\n0,0,0,0,0\\n")
drives = [
    control_drive(Table("t", {"kind": "simulated", "address": "unix:x"}), Path()),
    supervised_drive(Table("t", {"kind": "replay", "log": "x.csv"}), Path()),
    supervised_drive(Table("t", {"kind": "opcua", "url": "opc.tcp://localhost:1"}), Path()),
]
for drive in drives:
    drive.close()
print(*(type(drive).__name__ for drive in drives))
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert (ended.stdout, ended.stderr) == ("SimulatedControl Replay OpcUaDrive\n", "")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"role": "both"}, "role = 'both' is not allowed"),
        (
            {"listen": "0.0.0.0:7000"},
            "listen = '0.0.0.0:7000' is not allowed; give unix:PATH, relative to this file, or 127.0.0.1:PORT",
        ),
        ({"listen": "unix:"}, "listen = 'unix:' is not allowed"),
        ({"speed": -1.0}, "speed = -1.0 is not allowed"),
        ({"scenario": "other.toml"}, "scenario = 'other.toml' is not allowed"),
        ({"scenario": "fig15sampled"}, "or a table (did you mean 'fig15-sampled'?)"),
        ({"scenario": 3}, "scenario = 3 is not allowed; give a text in quotes"),
        ({"scenario": "fig15"}, "scenario controller sample rate: must be a number in Hz"),
        ({"block_s": 10.0}, "block_s = 10.0 s: must hold 1 to 4096 samples"),
        ({"keep_s": 0.01}, "keep_s = 0.01 s: must be at least block_s"),
        ({"watchdog": 1.0}, "unknown key 'watchdog' (did you mean 'watchdog_s'?)"),
    ],
)
def test_an_error_in_a_machines_file_is_one_sentence(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = plant_file(tmp_path, **{"role": "control", **changes})
    with pytest.raises(InvalidInput) as error:
        MachineSettings.load(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


def _ticked(drive: ControlDrive) -> DriveSample:
    sample = drive.read()
    assert sample is not None
    drive.write(0.0)
    return sample


@pytest.mark.slow
def test_a_copied_socket_leads_to_no_other_folders_machine_and_is_none_in_the_way(tmp_path: Path) -> None:
    """`cp -r` copies the file of a socket, and hard links (`cp -al`) would lead to the first folder's machine."""
    first, copy, links = tmp_path / "ax-1", tmp_path / "ax-2", tmp_path / "ax-3"
    for folder in (first, copy, links):
        folder.mkdir()
    with wire.new_socket(wire.Address(str(first / "drive.sock"))) as machine_of_first:
        machine_of_first.bind(str(first / "drive.sock"))
        machine_of_first.listen()
        machine_of_first.setblocking(False)
        subprocess.run(["cp", "-r", first / "drive.sock", copy], check=True)
        (links / "drive.sock").hardlink_to(first / "drive.sock")
        for folder, words in ((copy, "nobody listens at this socket"), (links, "hard link to the socket of another")):
            with closing(SimulatedControl(f"unix:{folder / 'drive.sock'}")) as drive:
                with pytest.raises(DriveLost, match=words):
                    drive.connect()
                with pytest.raises(BlockingIOError):
                    machine_of_first.accept()
        # The machine of the copy replaces the copied file.
        with listening(wire.Address(str(copy / "drive.sock"))) as machine_of_copy:
            machine_of_copy.setblocking(False)
            with closing(SimulatedControl(f"unix:{copy / 'drive.sock'}", silence=0.1)) as drive:
                with pytest.raises(DriveLost):  # accepted, but nobody answers
                    drive.connect()
                machine_of_copy.accept()[0].close()
