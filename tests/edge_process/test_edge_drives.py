"""The edge as a process on every kind of drive that controls by itself: windows hold what the machine did."""

import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from machines import plant_file, served
from test_opcua import server

from servotwin.cosim.machine import simulation_of
from servotwin.cosim.scenario import Scenario
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings
from servotwin.edge_process.config import UNBOOTED, EdgeConfig
from servotwin.edge_process.config_file import edge_toml
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.logs.columns import SignalTable
from servotwin.logs.log import write_log
from servotwin.messages import Setting, WindowMessage, unpack_channel

RATE, WINDOW = 5000.0, 0.5
SIMULATED = 5.0  # s: changes of the reference at 0, 2 and 4 s


def replayed(folder: Path, _stack: ExitStack) -> dict[str, Any]:
    plant_file(folder, "supervise", SIMULATED)
    simulation = simulation_of(Scenario.load(folder / "scenario.toml"))
    simulation.advance(simulation.samples - 1)
    run = simulation.run()
    columns = {"time_s": run.time, "reference_m": run.reference, "theta_m_rad": run.theta_m, "voltage_v": run.voltage}
    columns["measured_position_m"] = run.measured_position
    write_log(SignalTable(columns, {}), folder / "run.csv")
    return {"kind": "replay", "log": "run.csv", "speed": 0.0}


def simulated(folder: Path, stack: ExitStack) -> dict[str, Any]:
    return {"kind": "simulated", "address": stack.enter_context(served(plant_file(folder, "supervise", SIMULATED)))}


def over_opcua(folder: Path, stack: ExitStack) -> dict[str, Any]:
    url, _ = stack.enter_context(server(folder, ring=20_000))
    return {"kind": "opcua", "url": url, "poll_s": 0.1}


def windows_of(folder: Path) -> list[WindowMessage]:
    """What waits in the outbox, in order."""
    outbox = SqliteOutbox(folder / "outbox.sqlite", "axis")
    try:
        outbox.flush()
        return [outbox.get(key) for key in outbox.pending()]
    finally:
        outbox.close()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "count"), [(replayed, 3), (simulated, 3), (over_opcua, 2)])
def test_windows_hold_what_the_machine_did(tmp_path: Path, kind: Any, count: int) -> None:
    with ExitStack() as stack:
        drive = kind(tmp_path, stack)
        start = Parameters(setting=Setting(Scenario.load(tmp_path / "scenario.toml").start_tolerance))
        agent = AgentSettings("axis", UNBOOTED, RATE, WINDOW, parameters=start)
        config = EdgeConfig(agent, "supervise", None, drive, folder=tmp_path)
        (tmp_path / "edge.toml").write_text(edge_toml(config))
        edge = subprocess.Popen([sys.executable, "-m", "servotwin.edge_process", str(tmp_path / "edge.toml")])
        stack.callback(edge.wait)
        stack.callback(edge.kill)
        end = time.monotonic() + 90.0
        while edge.poll() is None and (kind is not over_opcua or len(windows_of(tmp_path)) < count):
            assert time.monotonic() < end
            time.sleep(0.1)
        if kind is over_opcua:
            edge.terminate()
        assert edge.wait(30) == 0
    windows = windows_of(tmp_path)
    assert len(windows) >= count
    if kind is over_opcua:  # its samples count from where the edge came in
        return
    simulation = simulation_of(Scenario.load(tmp_path / "scenario.toml"))
    simulation.advance(simulation.samples - 1)
    for window, begin in zip(windows, (0.0, 2.0, 4.0), strict=True):
        assert window.start == begin
        first = round(begin * RATE)
        for name in ("reference", "position", "theta_m", "voltage"):
            channel = window.channel(name)
            true = simulation.measured(name, first, first + round(WINDOW * RATE))
            assert np.max(np.abs(np.array(unpack_channel(channel)) - true)) <= 0.51 * channel.scale + 1e-12
