"""`servotwin bench endurance`: twin, machines and edges as processes under random faults; nothing may get lost.

Faults: kills of the twin, of its worker, of an edge and of its link process; a disk that is full for some seconds, for
the twin or for an edge; a damaged page in an edge's outbox; a twin or an edge that starts on a clock 90 days off. Of
many servos four have an edge; the others are simulated in one process (`endurance_crowd`), which is killed too.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import socket
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from pathlib import Path
from random import Random
from tempfile import mkdtemp
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.endurance_site import SERVOS, Member, Site, Witness, ask
from benchmarks.fleet.processes import check_system, children, used

SCHEMA, NAME = "servotwin-bench-endurance/1", "endurance"
QUICK, MINUTES = 0.5, 10.0
_FAULTS_S = (4.0, 12.0)
"""s between two faults, at least and at most."""
_DISK_S, _START_S, _END_S = 5.0, 120.0, 120.0
_KEPT = "[dim]the files are kept: {}[/]"
_CLOCKS_DAYS = (-90, 0, 90)
_YEAR_WINDOWS = 365.25 * 86400.0 / 20.0
"""Windows of a servo that sends one every 20 s, in a year."""


class EnduranceOutcome(NamedTuple):
    """Figures of a run.

    Attributes
    ----------
    servos : int
    seconds : float
    faults : dict of str to int
    starts, ended_alone, twin_ended : int
        Starts of edges, and those that ended without a fault; likewise ends of the twin. Both are started again.
    boots, stored : int
        Boots of edges from which windows are stored, and those windows.
    lost_acknowledged, holes, unseen, counted, waiting : int
        Windows that an edge has held as acknowledged and the store lacks; numbers that are missing within a boot; more
        windows that a boot's last status before a fault names as cut than are stored or waiting, also at its end; those
        that the edges themselves count as dropped; windows left in the outboxes.
    applied : int
        Updates that edges applied; one that is answered again, after a kill, counts once.
    unprocessed : dict of str to int
        Stored messages that no worker had processed when the twin was ended, by kind.
    refused : dict of str to int
        Messages of the crowd that the twin refused for good since its last start, by status.
    kept_bytes : dict of str to int
        Size of the twin's files at the end.
    bytes_per_window, outbox_bytes : float
        The store's size per window; of the largest outbox.
    memory : dict of str to (int, int)
        Largest resident bytes of each kind of process in the first and in the last third of the time.
    """

    servos: int
    seconds: float
    faults: dict[str, int]
    starts: int
    ended_alone: int
    twin_ended: int
    boots: int
    stored: int
    lost_acknowledged: int
    holes: int
    unseen: int
    counted: int
    waiting: int
    applied: int
    unprocessed: dict[str, int]
    refused: dict[str, int]
    kept_bytes: dict[str, int]
    bytes_per_window: float
    outbox_bytes: int
    memory: dict[str, tuple[int, int]]


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
            if self._site.crowd:
                self._deck.append(("crowd killed", self._kill_crowd))
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

    def _kill_crowd(self) -> None:
        assert self._site.crowd is not None
        self._again(self._site.crowd)

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
    date: str = "",
    output: Path | None = None,
    minutes: float = MINUTES,
    seed: int = 1,
    console: Console | None = None,
    servos: int = SERVOS,
) -> EnduranceOutcome:
    """Run a site under faults, print the table, and write JSON on request; `servos`: with and without edges.

    Raises
    ------
    InvalidInput
        The output cannot be written, or the system has no /proc.
    """
    console = console or Console()
    report.check(output)
    check_system()
    folder = Path(mkdtemp(prefix="endure-"))
    try:
        with console.status(f"{minutes:g} minutes of faults"):
            outcome = _outcome(Site(folder, _free_port(), minutes, servos - SERVOS), minutes, seed)
    except KeyboardInterrupt:
        shutil.rmtree(folder)
        raise
    except Exception:
        console.print(_KEPT.format(folder))
        raise
    failed = outcome.waiting or outcome.lost_acknowledged or outcome.holes or outcome.unseen
    if failed or outcome.ended_alone or outcome.twin_ended:
        console.print(_KEPT.format(folder))
    else:
        shutil.rmtree(folder)
    console.print(shown(outcome))
    report.write(output, report.text(SCHEMA, date, minutes=minutes, seed=seed, outcome=outcome._asdict()), console)
    return outcome


def _outcome(site: Site, minutes: float, seed: int) -> EnduranceOutcome:
    faults, random, witness = Faults(site, seed), Random(seed), Witness(site)
    samples: list[tuple[float, dict[str, int]]] = []
    with site.running():
        _until(site.begun, _START_S)
        begin = time.monotonic()
        while (now := time.monotonic() - begin) < 60.0 * minutes:
            samples.append((now, _memory(site)))
            time.sleep(random.uniform(*_FAULTS_S))
            witness.look()
            site.revive()
            faults.strike()
        for machine in site.machines.values():
            machine.kill()
        site.stop_crowd()
        _until(site.settled, _END_S)
        witness.look()
        for member in (*site.edges.values(), site.twin):
            member.end()
        return _figures(site, witness, faults.counts, samples)


def _figures(
    site: Site,
    witness: Witness,
    faults: Mapping[str, int],
    samples: list[tuple[float, dict[str, int]]],
) -> EnduranceOutcome:
    stored, waiting, boots = site.stored(), site.waiting(), dict[tuple[str, str], list[int]]()
    for servo, boot, sequence in stored:
        boots.setdefault((servo, boot), []).append(sequence)
    counts = "SELECT number FROM counts WHERE what LIKE 'dropped: %'"
    unseen = {each: cut - len(boots.get(each, ())) - waiting.get(each, 0) for each, cut in witness.cut.items()}
    answered = "SELECT DISTINCT servo, version FROM evidence WHERE kind = 'receipt' AND status = 'applied'"
    undone = "SELECT kind, count(*) FROM messages WHERE done IS NULL GROUP BY kind"
    seconds, crowd = samples[-1][0], site.crowd_status()
    acknowledged = witness.acknowledged | site.acknowledged_by_crowd()
    return EnduranceOutcome(
        servos=len(site.edges) + site.crowd_size,
        seconds=seconds,
        faults=dict(faults),
        starts=sum(edge.starts for edge in site.edges.values()),
        ended_alone=sum(edge.ended_alone for edge in site.edges.values()),
        twin_ended=site.twin.ended_alone,
        boots=len(boots),
        stored=len(stored),
        lost_acknowledged=len(acknowledged - stored),
        holes=sum(max(numbers) + 1 - len(numbers) for numbers in boots.values()),
        unseen=sum(max(0, number) for number in unseen.values()),
        counted=sum(number for servo in site.edges for (number,) in ask(site.outbox(servo), counts)),
        waiting=sum(waiting.values()) + crowd.waiting,
        refused=crowd.refused,
        kept_bytes={file.name: file.stat().st_size for file in sorted(site.folder.glob("twin.db*"))},
        applied=len(ask(site.folder / "twin.db", answered)),
        unprocessed=dict(ask(site.folder / "twin.db", undone)),
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


def _until(condition: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.5)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    return port


def shown(outcome: EnduranceOutcome) -> Table:
    """A row for each figure."""
    result = Table(title="endurance: windows under random faults", title_justify="left", box=None)
    result.add_column("figure")
    result.add_column("value", justify="right")
    year = outcome.bytes_per_window * _YEAR_WINDOWS
    refused = ", ".join(f"{number} with {status}" for status, number in sorted(outcome.refused.items())) or "0"
    rows = {
        "time, s; edges": f"{outcome.seconds:.0f}; {SERVOS}",
        "servos in all": str(outcome.servos),
        "starts of edges; ended without a fault": f"{outcome.starts}; {outcome.ended_alone}",
        "ends of the twin without a fault": str(outcome.twin_ended),
        "boots with stored windows": str(outcome.boots),
        **{f"faults: {name}": str(number) for name, number in sorted(outcome.faults.items())},
        "windows stored": str(outcome.stored),
        "acknowledged, and not stored": str(outcome.lost_acknowledged),
        "numbers missing within a boot": str(outcome.holes),
        "cut up to 1 s before a fault, and neither stored nor waiting": str(outcome.unseen),
        "dropped, counted by edges": str(outcome.counted),
        "left waiting": str(outcome.waiting),
        "refused for good, of the crowd": refused,
        "stored, not processed at the end: windows; letters": "; ".join(
            str(outcome.unprocessed.get(kind, 0)) for kind in ("window", "letter")
        ),
        "updates applied": str(outcome.applied),
        "store, kB per window; GB in a year of a servo": f"{outcome.bytes_per_window / 1e3:.1f}; {year / 1e9:.1f}",
        f"store of {outcome.servos} servos in a year, TB, without retention": f"{year * outcome.servos / 1e12:.1f}",
        "largest outbox, MB": f"{outcome.outbox_bytes / 1e6:.1f}",
        **{
            f"memory of a {kind}, MB: first, last third": f"{first / 1e6:.0f}, {last / 1e6:.0f}"
            for kind, (first, last) in outcome.memory.items()
        },
        **{
            f"growth of a {kind}, bytes per window; MB in a year": _growth(outcome, last - first)
            for kind, (first, last) in outcome.memory.items()
            if kind in ("twin", "worker")
        },
    }
    for name, value in rows.items():
        result.add_row(name, value)
    return result


def _growth(outcome: EnduranceOutcome, grown: int) -> str:
    """Growth of a process between the middles of two thirds of the time, by the windows that were stored then.

    In a year it would have grown by that much, if it did not stop growing.
    """
    if grown <= 0:
        return "none"
    windows = 2.0 / 3.0 * max(1, outcome.stored)
    year = outcome.servos * _YEAR_WINDOWS
    return f"{grown / windows:.1f}; {grown / windows * year / 1e6:.0f}"
