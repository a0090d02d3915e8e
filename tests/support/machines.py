"""Simulated machines as processes of their own, for tests."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from servotwin.drives.simulated.control import ControlServer
from servotwin.drives.simulated.plants import ControlledPlant, SupervisedPlant
from servotwin.drives.simulated.server import Server, StopRequest, address_in_use, listening, run, start_pace
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.drives.simulated.supervise import SuperviseServer

SCENARIO = """
servo = "paper"
duration_s = {duration}
[reference]
kind = "square"
amplitude_mm = 1.0
period_s = 4.0
[gap]
from_deg = 0.0
to_deg = 10.0
over_s = 15.0
begin_s = 1.0003
[recording]
sample_rate_hz = 5000.0
[controller]
sample_rate_hz = 5000.0
[noise]
std_mm = 0.05
[twin]
initial_gap_deg = 2.0
policy = "paper"
k_dz = 1.0
"""


def plant_file(folder: Path, role: str, duration: float = 25.0, **changes: Any) -> Path:
    """A machine's TOML and its scenario's; in lock-step and with an end unless changed."""
    (folder / "scenario.toml").write_text(SCENARIO.format(duration=duration))
    values = {"scenario": "scenario.toml", "role": role, "listen": "127.0.0.1:0", "speed": 0.0, "endless": False}
    path = folder / f"{role}.toml"
    path.write_text("".join(f"{key} = {_toml(value)}\n" for key, value in {**values, **changes}.items()))
    return path


@contextmanager
def machine(path: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A running machine: its address and its process, which is killed in the end."""
    command = [sys.executable, "-m", "servotwin.drives.simulated", str(path)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        ready = process.stdout.readline().split()
        assert ready[:1] == ["ready"], process.stderr.read()
        yield ready[1], process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        process.stderr.close()


@contextmanager
def served(path: Path) -> Iterator[str]:
    """A running machine in a thread of this process, which is quicker than a process of its own: its address."""
    settings, stop = MachineSettings.load(path), StopRequest()
    controlled = settings.role == "control"
    with listening(settings.address) as listener, closing(stop):
        pace = start_pace(settings)
        server: Server = (
            ControlServer(ControlledPlant(settings), pace, settings.slack)
            if controlled
            else SuperviseServer(SupervisedPlant(settings), pace)
        )
        thread = threading.Thread(target=run, args=(server, listener, settings, b"a thread", stop))
        thread.start()
        try:
            yield str(address_in_use(listener, settings.address))
        finally:
            stop()
            thread.join()


def _toml(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value).lower()
