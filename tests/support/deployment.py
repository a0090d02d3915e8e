"""A whole fleet for tests: machines, edges and a twin as processes that can be killed, and what they left on disk.

A witness in each outbox's file notes, in the very transaction, every window that was ever committed to it.
"""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from mosquitto import free_port

from benchmarks.endurance_site import MACHINE_TOML, TWIN_TOML
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.config_file import edge_toml, load
from servotwin.edge_process.monitoring import read_status
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.runtime.retry import Retry
from servotwin.twin_service.auth import Verifiers, write_tokens
from servotwin.up.enrolment import Enrolment, enroll

RATE, WINDOW_S = 500.0, 0.8
EVERY = 410
"""Samples between changes of the reference: windows follow each other closely."""
PATIENCE = 240.0
WITNESS = """
CREATE TABLE witness (boot TEXT NOT NULL, sequence INTEGER NOT NULL, UNIQUE (boot, sequence));
CREATE TRIGGER seen AFTER INSERT ON windows BEGIN INSERT OR IGNORE INTO witness VALUES (new.boot, new.sequence); END;
"""


class Process:
    """A command that can be started, killed with all its children, and started again."""

    def __init__(self, name: str, log: Path, folder: Path, arguments: Sequence[str]) -> None:
        self.name, self._log, self._folder = name, log / f"{name}.log", folder
        self._command = [sys.executable, *arguments]
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")[-4000:] if self._log.exists() else ""

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def start(self, **options: Any) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, cwd=self._folder, stdout=log, stderr=log, start_new_session=True, **options
            )

    def kill(self) -> None:
        """SIGKILL to it and to its children."""
        if self._process is not None:
            kill_group(self._process.pid)
            self._process.wait()

    def ask_to_end(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)

    def end(self) -> int:
        """Ask it to end; its exit status."""
        self.ask_to_end()
        return self.ended()

    def ended(self) -> int:
        assert self._process is not None
        try:
            return self._process.wait(PATIENCE)
        finally:
            kill_group(self._process.pid)


def logs(fleet: "Fleet") -> str:
    """The ends of all logs."""
    return "\n".join(f"{each.name}: {each.log}" for each in (fleet.twin, *fleet.edges.values()))


def end_all(processes: Collection[Process]) -> list[int]:
    """Ask all of them to end; their exit statuses."""
    for process in processes:
        process.ask_to_end()
    return [process.ended() for process in processes]


def kill_group(pid: int) -> None:
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


class Fleet:
    """A twin, machines and their edges in a folder.

    Parameters
    ----------
    folder : Path
    roles : sequence of str
        Of each servo: "control" or "supervise".
    service : str
        More of [service].
    edit : callable
        Changes an edge's configuration.
    store : str
        The twin's database.
    """

    def __init__(
        self,
        folder: Path,
        roles: Sequence[str],
        service: str = "",
        edit: Callable[[EdgeConfig], EdgeConfig] = lambda config: config,
        store: str = "twin.db",
    ) -> None:
        self.folder, self.port, self._edit = folder, free_port(), edit
        self.roles = {f"ax-{k}": role for k, role in enumerate(roles)}
        write_tokens(folder / "tokens.toml", Verifiers())
        self.database = folder / store
        keys = f'store = "sqlite:///{store}"\nspeed = 2.0\n{service}'
        text = TWIN_TOML.format(port=self.port, service=keys, rate=RATE, validity=1000.0)
        (folder / "twin.toml").write_text(text)
        self.twin = Process("twin", folder, folder, ["-m", "servotwin", "twin", "--config", "twin.toml"])
        run = ["-m", "servotwin.edge_process", "edge.toml"]
        self.edges = {servo: Process(servo, folder, folder / servo, run) for servo in self.roles}
        self._machines: subprocess.Popen[str] | None = None

    def start(self, url: str) -> None:
        """Machines first, then edges that reach the twin at a URL, and the twin."""
        for servo, address in zip(self.roles, self._start_machines(), strict=True):
            self._enroll(servo, address, url)
        self.twin.start()
        for edge in self.edges.values():
            edge.start()

    def stop_machines(self) -> None:
        """No more samples, so no more windows."""
        if self._machines is not None:
            self._machines.terminate()
            self._machines.wait(PATIENCE)
            assert self._machines.stdout is not None
            self._machines.stdout.close()
            self._machines = None

    def kill_all(self) -> None:
        self.stop_machines()
        for process in (*self.edges.values(), self.twin):
            process.kill()

    def status(self, servo: str) -> dict[str, Any]:
        return read_status(self.folder / servo / "status.json") or {}

    def connections(self) -> dict[str, list[dict[str, Any]]]:
        """Of each controlled machine, in order; once the machines have stopped."""
        result: dict[str, list[dict[str, Any]]] = {}
        for line in (self.folder / "machines.log").read_text().splitlines():
            entry = json.loads(line)
            result.setdefault(entry["servo"], []).append(entry)
        return result

    def _start_machines(self) -> list[str]:
        known = {"rate": RATE, "window": WINDOW_S, "period": 2 * EVERY / RATE}
        for number, (servo, role) in enumerate(self.roles.items()):
            # Those that are fast have more windows than the bad link carries at once: theirs come late.
            speed = 1.0 if role == "control" or number % 3 == 0 else 1.6
            place = {"listen": "127.0.0.1:0", "speed": speed, "duration": 300.0}
            text = MACHINE_TOML.format(servo=servo, role=role, seed=number, **place, **known)
            (self.folder / f"{servo}.toml").write_text(text)
        row, log = Path(__file__).with_name("plantrow.py"), self.folder / "machines.log"
        command = [sys.executable, str(row), str(log), *(f"{servo}.toml" for servo in self.roles)]
        self._machines = subprocess.Popen(command, cwd=self.folder, stdout=subprocess.PIPE, text=True)
        assert self._machines.stdout is not None
        word, *addresses = self._machines.stdout.readline().split() or ["nothing"]
        assert word == "ready"
        return addresses

    def _enroll(self, servo: str, address: str, url: str) -> None:
        folder, drive = self.folder / servo, {"kind": "simulated", "address": address, "silence_s": 0.0}
        enroll(self.folder / "twin.toml", Enrolment(servo, folder, self.roles[servo], RATE, drive, url))
        config = load(folder / "edge.toml")
        assert config.twin is not None
        agent = replace(config.agent, window_s=WINDOW_S, pre_trigger_s=0.0, retry=Retry(0.2, 2.0, 2.0))
        config = replace(config, agent=agent, twin=replace(config.twin, timeout_s=10.0, wait_s=5.0))
        (folder / "edge.toml").write_text(edge_toml(self._edit(config)))
        box = SqliteOutbox(folder / "outbox.sqlite", servo)
        box.close()
        with closing(sqlite3.connect(folder / "outbox.sqlite")) as database:
            database.executescript(WITNESS)


def until(condition: Callable[[], bool], what: Callable[[], str], seconds: float = PATIENCE) -> None:
    """`what` is asked for when it did not happen."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited in vain: {what()}"
        time.sleep(0.1)


@contextmanager
def deployed(fleet: Fleet, url: str) -> Iterator[Fleet]:
    try:
        fleet.start(url)
        yield fleet
    finally:
        fleet.kill_all()
