"""An edge as a process of its own, with its machine and its twin in this one."""

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from faketwin import FakeTwin
from stubmachine import StubMachine

import servotwin
from servotwin.control.controller import Controller
from servotwin.edge.guard import Limits
from servotwin.edge.settings import AgentSettings
from servotwin.edge_process.config import UNBOOTED, EdgeConfig, TwinLink
from servotwin.edge_process.config_file import edge_toml
from servotwin.edge_process.monitoring import read_status
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.runtime.retry import Retry

RATE = 500.0
LAW = Controller(200.0, 0.0, 0.0, 0.1, voltage_limit=10.0, sample_rate=RATE)
BLOCKER = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("numpy", "scipy", "numba", "matplotlib", "typer", "rich", "uvicorn", "sqlalchemy"):
            raise ModuleNotFoundError(f"{name} is not installed here")
sys.meta_path.insert(0, Absent())
"""


class RunningEdge:
    """A folder with an edge.toml, and the process that runs it."""

    def __init__(self, folder: Path, machine: StubMachine, twin: TwinLink | None) -> None:
        self.folder = folder
        agent = AgentSettings("axis-1", UNBOOTED, RATE, 0.2, retry=Retry(0.1, 2.0, 0.5), limits=Limits(maximum=1e-3))
        drive = {"kind": "simulated", "address": machine.address}
        self.config = EdgeConfig(agent, "control", LAW, drive, twin, folder=folder)
        (folder / "token").touch(0o600)
        (folder / "token").write_text("secret")
        self.write()
        blocked = folder / "blocked"
        blocked.mkdir()
        (blocked / "sitecustomize.py").write_text(BLOCKER)
        root = Path(servotwin.__file__).parents[1]
        self.environment = {**os.environ, "PYTHONPATH": f"{blocked}{os.pathsep}{root}"}
        self.process: subprocess.Popen[bytes] | None = None

    def write(self, **changes: Any) -> None:
        self.config = replace(self.config, **changes)
        (self.folder / "edge.toml").write_text(edge_toml(self.config))

    def start(self) -> None:
        command = [sys.executable, "-m", "servotwin.edge_process", str(self.folder / "edge.toml")]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(command, stderr=log, env=self.environment, start_new_session=True)

    def signal(self, number: int) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        return self.process.wait(60)

    def kill(self) -> None:
        """All of it at once, as a power cut does to processes."""
        if self.process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def status(self) -> dict[str, Any]:
        return read_status(self.folder / "status.json") or {}

    def outbox(self) -> list[tuple[str, int]]:
        box = SqliteOutbox(self.folder / "outbox.sqlite", "axis-1")
        box.flush()
        keys = box.pending()
        box.close()
        return keys

    def log(self) -> str:
        return (self.folder / "log").read_text()


def sequences(twin: FakeTwin) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for boot, sequence in sorted(twin.windows):
        found.setdefault(boot, []).append(sequence)
    return found


def is_complete(sequence: list[int]) -> bool:
    return sequence == list(range(len(sequence)))
