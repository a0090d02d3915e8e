"""Twin, machines, edges and a crowd of `servotwin bench endurance` as processes, and what they leave in a folder."""

from __future__ import annotations

import os
import secrets
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.endurance_crowd import ACKNOWLEDGED, STATUS, STOP, CrowdPlan, CrowdStatus
from benchmarks.overload import without_voltage
from servotwin.cosim import cosimulate
from servotwin.cosim.scenario import Scenario
from servotwin.edge_process.config_file import edge_toml, load
from servotwin.edge_process.monitoring import read_status
from servotwin.link.seal import verifier_of
from servotwin.messages import WindowMessage, encode
from servotwin.runtime.retry import Retry
from servotwin.twin_service.auth import read_tokens, write_tokens
from servotwin.up.enrolment import Enrolment, enroll

SERVOS = 4
_RATE, _WINDOW_S, _PERIOD_S = 500.0, 0.8, 1.64
_END_S, _PATIENCE_S = 120.0, 60.0
_CROWD_PERIOD_S, _CROWD_CONNECTIONS = 20.0, 32
TWIN_TOML = """
[service]
port = {port}
tokens = "tokens.toml"
workers = 1
rate_limit_per_s = 1000
{service}
[models.paper]
servo = "paper"
[models.paper.controller]
sample_rate_hz = {rate}
[models.paper.twin]
policy = "paper"
k_dz = 1.0
initial_gap_deg = 2.0
validity_s = {validity}
[servos]
"ax-*" = "paper"
"""
MACHINE_TOML = """
role = "{role}"
listen = "{listen}"
speed = {speed}
slack_s = 60.0
watchdog_s = 0.5
block_s = 0.1
[scenario]
servo = "paper"
name = "{servo}"
duration_s = {duration}
seed = {seed}
[scenario.reference]
kind = "square"
amplitude_mm = 1.0
period_s = {period}
[scenario.gap]
from_deg = 2.0
to_deg = 20.0
over_s = {duration}
[scenario.recording]
sample_rate_hz = {rate}
window_s = {window}
[scenario.controller]
sample_rate_hz = {rate}
[scenario.noise]
std_mm = 0.001
[scenario.twin]
initial_gap_deg = 2.0
policy = "paper"
k_dz = 1.0
"""
_CLOCK = """
import os, time
_ahead, _time, _ns = float(os.environ.get("BENCH_CLOCK_S", 0)), time.time, time.time_ns
if _ahead:
    time.time = lambda: _time() + _ahead
    time.time_ns = lambda: _ns() + int(_ahead * 1e9)
"""


Window = tuple[str, str, int]
"""Servo, boot and sequence."""


class Member:
    """A process that is killed and started again.

    Parameters
    ----------
    folder : Path
    log : Path
    arguments : str
        Of Python.

    Attributes
    ----------
    starts, ended_alone : int
        Number of starts; of those that had ended without a fault when the next fault or the end of the run came.
    """

    def __init__(self, folder: Path, log: Path, *arguments: str) -> None:
        self._folder, self._log, self._command = folder, log, [sys.executable, *arguments]
        self.process: subprocess.Popen[bytes] | None = None
        self.starts = self.ended_alone = 0
        self._running, self._clock_s = False, 0.0

    @property
    def pid(self) -> int:
        """Process id; 0: it does not run."""
        return 0 if self.process is None or self.process.poll() is not None else self.process.pid

    def start(self, clock_s: float = 0.0) -> None:
        """Start, on a clock that is ahead."""
        environment = {**os.environ, "PYTHONPATH": _python_path(self._log.parent), "BENCH_CLOCK_S": str(clock_s)}
        self.starts, self._running, self._clock_s = self.starts + 1, True, clock_s
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                self._command, cwd=self._folder, stdout=log, stderr=log, env=environment, start_new_session=True
            )

    def revive(self) -> None:
        """Start it again where it has ended without a fault, as a service manager would."""
        if self._running and not self.pid:
            self.kill()
            self.start(self._clock_s)

    def kill(self) -> None:
        """Kill it and its children."""
        if self.process is not None:
            self.ended_alone += self._running and self.process.poll() is not None
            self._running = False
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def end(self) -> None:
        """Ask it to end, and wait."""
        if self.process is not None and self.process.poll() is None:
            self._running = False
            self.process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(_END_S)
        self.kill()


class Site:
    """A twin, machines and their edges in a folder, and a crowd of simulated servos beside them.

    Parameters
    ----------
    folder : Path
    port : int
        Of the twin.
    minutes : float
    crowd : int
        Simulated servos.
    """

    def __init__(self, folder: Path, port: int, minutes: float, crowd: int = 0) -> None:
        self.folder, self.crowd_size = folder, crowd
        (folder / "sitecustomize.py").write_text(_CLOCK, encoding="utf-8")
        twin = TWIN_TOML.format(port=port, service='log_level = "warning"', rate=_RATE, validity=100.0)
        (folder / "twin.toml").write_text(twin, encoding="utf-8")
        self.twin = Member(folder, folder / "twin.log", "-m", "servotwin", "twin")
        self.edges: dict[str, Member] = {}
        self.machines: dict[str, Member] = {}
        for number in range(SERVOS):
            self._add(f"ax-{number}", number, 60.0 * minutes + 600.0)
        self.crowd = self._crowd(port) if crowd else None

    def _crowd(self, port: int) -> Member:
        """Give each servo of the crowd a token, and prepare its process."""
        tokens = {f"ax-c{number:05d}": secrets.token_hex(16) for number in range(self.crowd_size)}
        file = self.folder / "tokens.toml"
        known = read_tokens(file)
        made = {name: verifier_of(token) for name, token in tokens.items()}
        write_tokens(file, replace(known, servos={**known.servos, **made}))
        plan = CrowdPlan(port, tokens, _CROWD_PERIOD_S, _CROWD_CONNECTIONS, tuple(map(encode, self._templates())))
        (self.folder / "crowd.plan").write_bytes(msgspec.msgpack.encode(plan))
        command = ("-m", "benchmarks.endurance_crowd", str(self.folder / "crowd.plan"))
        return Member(Path(__file__).parents[1], self.folder / "crowd.log", *command)

    def _templates(self) -> list[WindowMessage]:
        """Windows of a machine as the real ones are, in a loop on its own."""
        known = {"servo": "ax-c", "seed": 0, "rate": _RATE, "window": _WINDOW_S, "period": _PERIOD_S}
        text = MACHINE_TOML.format(role="supervise", listen="", speed=1.0, duration=60.0, **known)
        file = self.folder / "crowd.toml"
        file.write_text(text.partition("[scenario]")[2].replace("[scenario.", "["), encoding="utf-8")
        return [without_voltage(window) for window in cosimulate(Scenario.load(file)).windows[4:]]

    def _add(self, servo: str, seed: int, duration: float) -> None:
        folder = self.folder / servo
        drive = {"kind": "simulated", "address": "unix:drive.sock", "silence_s": 5.0}
        enroll(self.folder / "twin.toml", Enrolment(servo, folder, "supervise", _RATE, drive))
        config = load(folder / "edge.toml")
        agent = replace(config.agent, window_s=_WINDOW_S, pre_trigger_s=0.0, retry=Retry(0.2, 2.0, 2.0))
        (folder / "edge.toml").write_text(edge_toml(replace(config, agent=agent)), encoding="utf-8")
        known = {"servo": servo, "seed": seed, "rate": _RATE, "window": _WINDOW_S, "period": _PERIOD_S}
        listen = f"unix:{servo}/drive.sock"
        text = MACHINE_TOML.format(role="supervise", listen=listen, speed=1.0, duration=duration, **known)
        (self.folder / f"{servo}.toml").write_text(text, encoding="utf-8")
        machine = ("-m", "servotwin.drives.simulated", f"{servo}.toml")
        self.machines[servo] = Member(self.folder, self.folder / f"{servo}-machine.log", *machine)
        self.edges[servo] = Member(
            folder, self.folder / f"{servo}-edge.log", "-m", "servotwin.edge_process", "edge.toml"
        )

    @contextmanager
    def running(self) -> Iterator[None]:
        """Start all; kill what is left in the end."""
        members = [*self.machines.values(), self.twin, *self.edges.values(), *([self.crowd] if self.crowd else [])]
        try:
            for each in members:
                each.start()
            yield
        finally:
            for each in members:
                each.kill()

    def revive(self) -> None:
        """Start what has ended without a fault again, but for machines."""
        stopped = (self.folder / STOP).exists()
        for each in (self.twin, *self.edges.values(), *([self.crowd] if self.crowd and not stopped else [])):
            each.revive()

    def stop_crowd(self) -> None:
        """Have the crowd send what it has cut, and end."""
        (self.folder / STOP).touch()

    def crowd_status(self) -> CrowdStatus:
        """Last status of the crowd."""
        try:
            return msgspec.json.decode((self.folder / STATUS).read_bytes(), type=CrowdStatus)
        except OSError:
            return CrowdStatus(0, 0, {})

    def acknowledged_by_crowd(self) -> set[Window]:
        """Windows of which the crowd has an acknowledgement."""
        file = self.folder / ACKNOWLEDGED
        lines = file.read_text(encoding="ascii").splitlines() if file.exists() else []
        fields = [line.split() for line in lines]
        # A kill may have cut the last line of a process; the next one begins behind it.
        return {(one[0], one[1], int(one[2])) for one in fields if len(one) == 3 and one[2].isdigit()}

    def settled(self) -> bool:
        """True where no window waits; what has ended without a fault is started again."""
        self.revive()
        return not (self.crowd and self.crowd.pid) and not self.waiting()

    def outbox(self, servo: str) -> Path:
        """File of an edge's outbox."""
        return self.folder / servo / "outbox.sqlite"

    def waiting(self) -> dict[tuple[str, str], int]:
        """Numbers of windows in the outboxes that are not acknowledged, by servo and boot."""
        text = (
            "SELECT boot, count(*) FROM windows "
            "WHERE (boot, sequence) NOT IN (SELECT boot, sequence FROM acknowledged) GROUP BY boot"
        )
        return {(servo, boot): number for servo in self.edges for boot, number in ask(self.outbox(servo), text)}

    def stored(self) -> set[Window]:
        """Windows in the store."""
        text = "SELECT servo, boot, sequence FROM messages WHERE kind = 'window'"
        return set(ask(self.folder / "twin.db", text))

    def begun(self) -> bool:
        """True where windows have come from all edges."""
        try:
            with closing(sqlite3.connect(f"file:{self.folder / 'twin.db'}?mode=ro", uri=True)) as database:
                [(servos,)] = database.execute("SELECT count(DISTINCT servo) FROM messages WHERE kind = 'window'")
        except sqlite3.Error:
            return False
        return bool(servos == len(self.edges) + self.crowd_size)


class Witness:
    """Notes during the run what edges have said, since a fault may take their files.

    Attributes
    ----------
    acknowledged : set of (str, str, int)
        Windows that an edge has held as acknowledged.
    cut : dict
        Most windows that a status of a boot has named as cut, by servo and boot.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self.acknowledged = set[Window]()
        self.cut: dict[tuple[str, str], int] = {}

    def look(self) -> None:
        """Note what is there now; raises RuntimeError where an outbox cannot be read."""
        for servo in self._site.edges:
            file = self._site.outbox(servo)
            rows = ask(file, "SELECT boot, sequence FROM acknowledged") if file.exists() else []
            self.acknowledged |= {(servo, boot, sequence) for boot, sequence in rows}
            status = read_status(file.with_name("status.json")) or {}
            boot, number = status.get("boot"), status.get("windows_cut")
            if isinstance(boot, str) and isinstance(number, int):
                self.cut[servo, boot] = max(number, self.cut.get((servo, boot), 0))


def ask(file: Path, text: str) -> list[Any]:
    """Rows of a query; a file that is being replaced, or is damaged until its edge has replaced it, is tried again.

    Raises
    ------
    RuntimeError
        It cannot be read for a while.
    """
    end = time.monotonic() + _PATIENCE_S
    while True:
        try:
            with closing(sqlite3.connect(f"file:{file}?mode=rw", uri=True, timeout=_PATIENCE_S)) as database:
                return database.execute(text).fetchall()
        except sqlite3.Error as error:
            if time.monotonic() > end:
                raise RuntimeError(f"{file}: cannot be read ({error})") from None
            time.sleep(0.2)


def _python_path(folder: Path) -> str:
    known = os.environ.get("PYTHONPATH", "")
    return f"{folder}{os.pathsep}{known}" if known else str(folder)
