"""`servotwin bench endurance`: twin, machines and edges as processes under random faults; nothing may get lost.

Faults: kills of the twin, of its worker, of an edge and of its link process; a disk that is full for some seconds, for
the twin or for an edge; a damaged page in an edge's outbox; a twin or an edge that starts on a clock 90 days off.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.fleet.processes import check_system, children, used
from servotwin.edge_process.config_file import edge_toml, load
from servotwin.runtime.retry import Retry
from servotwin.up.enrolment import Enrolment, enroll

SCHEMA, NAME = "servotwin-bench-endurance/1", "endurance"
QUICK, MINUTES = 0.5, 10.0
_SERVOS, _RATE, _WINDOW_S, _PERIOD_S = 4, 500.0, 0.8, 1.64
_FAULTS_S = (4.0, 12.0)
"""s between two faults, at least and at most."""
_DISK_S, _START_S, _END_S = 5.0, 120.0, 120.0
_CLOCKS_DAYS = (-90, 0, 90)
_YEAR_WINDOWS = 365.25 * 86400.0 / 20.0
"""Windows of a servo that sends one every 20 s, in a year."""
_TWIN = """
[service]
port = {port}
tokens = "tokens.toml"
workers = 1
rate_limit_per_s = 1000
log_level = "warning"
[models.paper]
servo = "paper"
[models.paper.controller]
sample_rate_hz = {rate}
[models.paper.twin]
policy = "paper"
k_dz = 1.0
initial_gap_deg = 2.0
validity_s = 100.0
[servos]
"ax-*" = "paper"
"""
_MACHINE = """
role = "supervise"
listen = "unix:{folder}/drive.sock"
slack_s = 60.0
block_s = 0.1
[scenario]
servo = "paper"
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


class EnduranceOutcome(NamedTuple):
    """Figures of a run.

    Attributes
    ----------
    seconds : float
    faults : dict of str to int
    boots, stored : int
        Starts of edges from which windows are stored, and those windows.
    lost_acknowledged, holes, counted, waiting : int
        Windows that an edge holds as acknowledged and the store lacks; numbers that are missing within a boot; windows
        that the edges themselves count as dropped; windows left in the outboxes.
    applied : int
        Updates that edges applied.
    bytes_per_window, outbox_bytes : float
        The store's size per window; of the largest outbox.
    memory : dict of str to (int, int)
        Largest resident bytes of each kind of process in the first and in the last third of the time.
    """

    seconds: float
    faults: dict[str, int]
    boots: int
    stored: int
    lost_acknowledged: int
    holes: int
    counted: int
    waiting: int
    applied: int
    bytes_per_window: float
    outbox_bytes: int
    memory: dict[str, tuple[int, int]]


class Member:
    """A process that is killed and started again.

    Parameters
    ----------
    folder : Path
    log : Path
    arguments : str
        Of Python.
    """

    def __init__(self, folder: Path, log: Path, *arguments: str) -> None:
        self._folder, self._log, self._command = folder, log, [sys.executable, *arguments]
        self.process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Process id; 0: it does not run."""
        return 0 if self.process is None or self.process.poll() is not None else self.process.pid

    def start(self, clock_s: float = 0.0) -> None:
        """Start, on a clock that is ahead."""
        environment = {**os.environ, "PYTHONPATH": _python_path(self._log.parent), "BENCH_CLOCK_S": str(clock_s)}
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                self._command, cwd=self._folder, stdout=log, stderr=log, env=environment, start_new_session=True
            )

    def kill(self) -> None:
        """Kill it and its children."""
        if self.process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def end(self) -> None:
        """Ask it to end, and wait."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(_END_S)
        self.kill()


class Site:
    """A twin, machines and their edges in a folder."""

    def __init__(self, folder: Path, port: int, minutes: float) -> None:
        self.folder = folder
        (folder / "sitecustomize.py").write_text(_CLOCK, encoding="utf-8")
        (folder / "twin.toml").write_text(_TWIN.format(port=port, rate=_RATE), encoding="utf-8")
        self.twin = Member(folder, folder / "twin.log", "-m", "servotwin", "twin")
        self.edges: dict[str, Member] = {}
        self.machines: dict[str, Member] = {}
        for number in range(_SERVOS):
            self._add(f"ax-{number}", number, 60.0 * minutes + 600.0)

    def _add(self, servo: str, seed: int, duration: float) -> None:
        folder = self.folder / servo
        drive = {"kind": "simulated", "address": "unix:drive.sock", "silence_s": 5.0}
        enroll(self.folder / "twin.toml", Enrolment(servo, folder, "supervise", _RATE, drive))
        config = load(folder / "edge.toml")
        agent = replace(config.agent, window_s=_WINDOW_S, pre_trigger_s=0.0, retry=Retry(0.2, 2.0, 2.0))
        (folder / "edge.toml").write_text(edge_toml(replace(config, agent=agent)), encoding="utf-8")
        known = {"folder": servo, "seed": seed, "rate": _RATE, "window": _WINDOW_S, "period": _PERIOD_S}
        (self.folder / f"{servo}.toml").write_text(_MACHINE.format(duration=duration, **known), encoding="utf-8")
        machine = ("-m", "servotwin.drives.simulated", f"{servo}.toml")
        self.machines[servo] = Member(self.folder, self.folder / f"{servo}-machine.log", *machine)
        self.edges[servo] = Member(
            folder, self.folder / f"{servo}-edge.log", "-m", "servotwin.edge_process", "edge.toml"
        )

    @contextmanager
    def running(self) -> Iterator[None]:
        """Start all; kill what is left in the end."""
        members = [*self.machines.values(), self.twin, *self.edges.values()]
        try:
            for each in members:
                each.start()
            yield
        finally:
            for each in members:
                each.kill()

    def outbox(self, servo: str) -> Path:
        """File of an edge's outbox."""
        return self.folder / servo / "outbox.sqlite"

    def waiting(self) -> int:
        """Windows in the outboxes that are not acknowledged."""
        text = "SELECT count(*) FROM windows WHERE (boot, sequence) NOT IN (SELECT boot, sequence FROM acknowledged)"
        return sum(_ask(self.outbox(servo), text)[0][0] for servo in self.edges)

    def stored(self) -> set[tuple[str, str, int]]:
        """Windows in the store; none before there is one."""
        file = self.folder / "twin.db"
        text = "SELECT servo, boot, sequence FROM messages WHERE kind = 'window'"
        return set(_ask(file, text)) if file.exists() else set()


class Faults:
    """Random faults, one at a time."""

    def __init__(self, site: Site, seed: int) -> None:
        self._site, self._random = site, Random(seed)
        self.counts: Counter[str] = Counter()
        self._deck: list[tuple[str, Callable[[], None]]] = []

    def strike(self) -> None:
        """Deal the next fault; all come before one comes again."""
        if not self._deck:
            self._deck = [
                ("twin killed", self._kill_twin), ("worker killed", self._kill_worker),
                ("edge killed", self._kill_edge), ("link process killed", self._kill_link),
                ("twin's disk full", self._fill_twin),
                ("edge's disk full", self._fill_edge), ("page of an outbox damaged", self._damage),
                ("twin's clock", self._step_twin), ("edge's clock", self._step_edge),
            ]  # fmt: skip
            self._random.shuffle(self._deck)
        name, act = self._deck.pop()
        act()
        self.counts[name] += 1

    def _edge(self) -> tuple[str, Member]:
        return self._random.choice(list(self._site.edges.items()))

    def _clock(self) -> float:
        return 86400.0 * self._random.choice(_CLOCKS_DAYS)

    def _again(self, member: Member, clock_s: float = 0.0) -> None:
        member.kill()
        time.sleep(self._random.uniform(0.0, 1.5))
        member.start(clock_s)

    def _kill_twin(self) -> None:
        self._again(self._site.twin)

    def _kill_worker(self) -> None:
        for pid in children(self._site.twin.pid)[:1]:
            os.kill(pid, signal.SIGKILL)

    def _kill_edge(self) -> None:
        self._again(self._edge()[1])

    def _kill_link(self) -> None:
        for pid in children(self._edge()[1].pid)[:1]:
            os.kill(pid, signal.SIGKILL)

    def _fill_twin(self) -> None:
        _full_disk([self._site.twin.pid])

    def _fill_edge(self) -> None:
        _full_disk(children(self._edge()[1].pid))

    def _step_twin(self) -> None:
        self._again(self._site.twin, self._clock())

    def _step_edge(self) -> None:
        self._again(self._edge()[1], self._clock())

    def _damage(self) -> None:
        """Overwrite a page while the edge is dead; the log of its file is merged before, as a stop would do."""
        servo, member = self._edge()
        member.kill()
        file = self._site.outbox(servo)
        with closing(sqlite3.connect(file)) as database:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        pages = file.stat().st_size // 4096
        with file.open("r+b") as open_file:
            open_file.seek(4096 * self._random.randrange(1, max(2, pages)))
            open_file.write(self._random.randbytes(4096))
        member.start()


def _full_disk(pids: list[int]) -> None:
    """No file of these processes may be written for some seconds: EFBIG in place of ENOSPC."""
    for pid in filter(None, pids):
        with suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    time.sleep(_DISK_S)
    for pid in filter(None, pids):
        with suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def endure(
    date: str = "", output: Path | None = None, minutes: float = MINUTES, seed: int = 1, console: Console | None = None
) -> EnduranceOutcome:
    """Run a site under faults, print the table, and write JSON on request.

    Raises
    ------
    InvalidInput
        The output cannot be written, or the system has no /proc.
    """
    console = console or Console()
    report.check(output)
    check_system()
    with TemporaryDirectory(prefix="endure-") as name, console.status(f"{minutes:g} minutes of faults"):
        outcome = _outcome(Site(Path(name), _free_port(), minutes), minutes, seed)
    console.print(shown(outcome))
    report.write(output, report.text(SCHEMA, date, minutes=minutes, seed=seed, outcome=outcome._asdict()), console)
    return outcome


def _outcome(site: Site, minutes: float, seed: int) -> EnduranceOutcome:
    faults, random = Faults(site, seed), Random(seed)
    samples: list[tuple[float, dict[str, int]]] = []
    with site.running():
        _until(lambda: len(site.stored()) > _SERVOS, _START_S)
        begin = time.monotonic()
        while (now := time.monotonic() - begin) < 60.0 * minutes:
            samples.append((now, _memory(site)))
            time.sleep(random.uniform(*_FAULTS_S))
            faults.strike()
        for machine in site.machines.values():
            machine.kill()
        if not site.twin.pid:
            site.twin.start()
        _until(lambda: site.waiting() == 0, _END_S)
        for member in (*site.edges.values(), site.twin):
            member.end()
        return _figures(site, faults.counts, samples)


def _figures(
    site: Site,
    faults: Mapping[str, int],
    samples: list[tuple[float, dict[str, int]]],
) -> EnduranceOutcome:
    stored, counted = site.stored(), 0
    acknowledged = set[tuple[str, str, int]]()
    for servo in site.edges:
        rows = _ask(site.outbox(servo), "SELECT boot, sequence FROM acknowledged")
        acknowledged |= {(servo, boot, sequence) for boot, sequence in rows}
        counts = _ask(site.outbox(servo), "SELECT number FROM counts WHERE what LIKE 'dropped: %'")
        counted += sum(number for (number,) in counts)
    boots: dict[tuple[str, str], list[int]] = {}
    for servo, boot, sequence in stored:
        boots.setdefault((servo, boot), []).append(sequence)
    applied = "SELECT count(*) FROM evidence WHERE kind = 'receipt' AND status = 'applied'"
    seconds = samples[-1][0]
    return EnduranceOutcome(
        seconds=seconds,
        faults=dict(faults),
        boots=len(boots),
        stored=len(stored),
        lost_acknowledged=len(acknowledged - stored),
        holes=sum(max(numbers) + 1 - len(numbers) for numbers in boots.values()),
        counted=counted,
        waiting=site.waiting(),
        applied=_ask(site.folder / "twin.db", applied)[0][0],
        bytes_per_window=(site.folder / "twin.db").stat().st_size / max(1, len(stored)),
        outbox_bytes=max(site.outbox(servo).stat().st_size for servo in site.edges),
        memory={
            kind: (
                max(sample[kind] for at, sample in samples if at <= seconds / 3.0),
                max(sample[kind] for at, sample in samples if at >= seconds * 2.0 / 3.0),
            )
            for kind in samples[0][1]
        },
    )


def _memory(site: Site) -> dict[str, int]:
    """Largest resident bytes of each kind of process."""
    edges = [edge.pid for edge in site.edges.values()]
    kinds = {
        "twin": [site.twin.pid],
        "worker": children(site.twin.pid),
        "edge": edges,
        "link process": [pid for edge in edges for pid in children(edge)],
    }
    usages = {kind: [used(pid) for pid in pids if pid] for kind, pids in kinds.items()}
    return {kind: max((each.memory for each in found if each is not None), default=0) for kind, found in usages.items()}


def _ask(file: Path, text: str) -> list[Any]:
    """Rows of a query; none where the file is new, or is being replaced."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(file, timeout=30.0)) as database:
        return database.execute(text).fetchall()
    return [(0,)] if "count(*)" in text else []


def _until(condition: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.5)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    return port


def _python_path(folder: Path) -> str:
    known = os.environ.get("PYTHONPATH", "")
    return f"{folder}{os.pathsep}{known}" if known else str(folder)


def shown(outcome: EnduranceOutcome) -> Table:
    """A row for each figure."""
    result = Table(title="endurance: windows under random faults", title_justify="left", box=None)
    result.add_column("figure")
    result.add_column("value", justify="right")
    year = outcome.bytes_per_window * _YEAR_WINDOWS
    rows = {
        "time, s; edges; boots": f"{outcome.seconds:.0f}; {_SERVOS}; {outcome.boots}",
        **{f"faults: {name}": str(number) for name, number in sorted(outcome.faults.items())},
        "windows stored": str(outcome.stored),
        "acknowledged, and not stored": str(outcome.lost_acknowledged),
        "numbers missing within a boot": str(outcome.holes),
        "dropped, counted by edges": str(outcome.counted),
        "left waiting": str(outcome.waiting),
        "updates applied": str(outcome.applied),
        "store, kB per window; GB in a year of a servo": f"{outcome.bytes_per_window / 1e3:.1f}; {year / 1e9:.1f}",
        "largest outbox, MB": f"{outcome.outbox_bytes / 1e6:.1f}",
        **{
            f"memory of a {kind}, MB: first, last third": f"{first / 1e6:.0f}, {last / 1e6:.0f}"
            for kind, (first, last) in outcome.memory.items()
        },
    }
    for name, value in rows.items():
        result.add_row(name, value)
    return result
