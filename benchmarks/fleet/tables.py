"""Results of the bench beside its targets."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks.fleet.runs import FleetRun
from benchmarks.fleet.setting import FleetScale
from benchmarks.fleet.watch import EDGES, TWIN, WORKERS
from benchmarks.report import cores, machine

ROLES = (EDGES, TWIN, WORKERS)
ASKED_INGEST = 2000.0
WITHIN_S = 30.0, 60.0, 90.0, 240.0
_MB = 1e6


class ReportLine(NamedTuple):
    """One line of the table."""

    what: str
    asked: str
    measured: str


def lines(scale: FleetScale, alone: FleetRun, whole: FleetRun) -> Iterator[ReportLine]:
    """Yield all lines: ingest, cadence, outage, memory."""
    yield from _of_ingest(alone)
    yield from _of_cadence(scale, whole)
    yield from _of_outage(scale, whole)
    for role in ROLES:
        first, middle, most = (size / _MB for size in whole.watch.memory(role))
        yield ReportLine(f"memory of the {role}: first, half-way, most", "bounded", _numbers("MB", first, middle, most))


def _of_ingest(alone: FleetRun) -> Iterator[ReportLine]:
    report = alone.report
    yield ReportLine(
        "windows/s committed, nobody estimates", f">= {ASKED_INGEST:g}", f"{report.windows / report.seconds:.0f}"
    )
    yield ReportLine("... of bytes", "20 kB", f"{report.bytes / max(1, report.windows) / 1e3:.1f} kB")
    yield ReportLine(
        "... request to answer: median, 99 %, most", "", _numbers("ms", *(1e3 * x for x in report.latency))
    )
    yield ReportLine("... cores kept busy: edges, twin, workers", "2", _cores(alone))


def _of_cadence(scale: FleetScale, whole: FleetRun) -> Iterator[ReportLine]:
    report, steady = whole.report, whole.steady
    seconds = 0.9 * scale.steady
    yield ReportLine(f"{scale.servos} servos, windows/s", f"{scale.rate:g}", f"{steady.windows / seconds:.0f}")
    yield ReportLine(
        "... with news", f"{100.0 * scale.news:g} %", f"{100.0 * report.news / max(1, report.windows):.1f} %"
    )
    estimated, glances = whole.made.get("estimate", 0), max(1, whole.made.get("glance", 0))
    yield ReportLine("... estimated, the others glanced at", "", f"{100.0 * estimated / glances:.1f} %")
    verifications = whole.made.get("verification", 0)
    yield ReportLine("... updates, verifications by now", "", f"{whole.made.get('update', 0)}, {verifications}")
    yield ReportLine("... queue age: median, 99 %, most", "0.25 s (99 %)", _numbers("s", *steady.age))
    yield ReportLine("... of windows with nothing new", "", _numbers("s", *steady.glanced))
    yield ReportLine("... of windows that were estimated", "", _numbers("s", *steady.estimated))
    yield ReportLine(
        "... request to answer: median, 99 %, most", "", _numbers("ms", *(1e3 * x for x in report.latency))
    )
    yield ReportLine(
        "... behind schedule at the edges: median, 99 %, most", "", _numbers("ms", *(1e3 * x for x in report.late))
    )
    yield ReportLine("... cores kept busy: edges, twin, workers", "2", _cores(whole))
    others, withheld = whole.watch.elsewhere()
    yield ReportLine("... by other work; withheld by the host", "0; 0", f"{others:.2f}; {withheld:.2f}")
    spent = [1e3 * whole.watch.spent(role) / max(1, report.windows) for role in ROLES]
    allowed = 1e3 * cores() / scale.rate
    yield ReportLine("... processor time per window: the same", f"< {allowed:.3g} ms", _numbers("ms", *spent))


def _of_outage(scale: FleetScale, whole: FleetRun) -> Iterator[ReportLine]:
    report = whole.report
    yield ReportLine(f"after {scale.outage:g} s without a link, windows behind", "", f"{whole.behind:.0f}")
    fresh, backlog = whole.fresh, whole.backlog
    yield ReportLine(
        "... newest window of each servo processed: servos, within",
        f"{scale.servos}, 30 s",
        f"{len(fresh)}, {max(fresh, default=math.nan):.0f} s",
    )
    within = ", ".join(f"{until:g}" for until in WITHIN_S)
    yield ReportLine(f"... share of the servos within {within} s", "100 % within 30 s", _within(fresh, scale.servos))
    yield ReportLine("... not overtaken while it waited for its estimate", "", _within(whole.judged, scale.servos))
    yield ReportLine(
        "... request to answer since then: median, 99 %, most",
        "",
        _numbers("ms", *(1e3 * x for x in report.latency_after)),
    )
    yield ReportLine(
        f"... {backlog.windows} windows of the outage taken: half, 99 %, all after", "", _numbers("s", *backlog.came)
    )
    undone = f"; {backlog.undone} not" if backlog.undone else ""
    yield ReportLine("... and processed", "", _numbers("s", *backlog.processed) + undone)
    if math.isnan(whole.drained):
        yield ReportLine("... worked off within", "drains", "not: more comes than can be worked on")
        return
    yield ReportLine("... worked off within", "drains", f"{whole.drained:.0f} s")
    came = scale.rate * min(whole.drained, scale.after)
    rate = (whole.behind + came) / max(whole.drained, 1.0)
    yield ReportLine("... windows/s worked on meanwhile", f"> {scale.rate:g}", f"{rate:.0f}")


def show(scale: FleetScale, alone: FleetRun, whole: FleetRun, console: Console) -> None:
    """Print the table, and the machine that it was measured on."""
    table = Table("what", "asked", "measured", box=None, pad_edge=False)
    for line in lines(scale, alone, whole):
        table.add_row(*line)
    console.print(table, highlight=False)
    host = machine()
    console.print(f"{host['cpu']}, {host['cores']} cores, {host['python']}", highlight=False)
    console.print(_load_share(whole), highlight=False)


def _load_share(whole: FleetRun) -> str:
    """Sentence about the load that shares the machine with the twin."""
    spent = {role: whole.watch.spent(role) for role in ROLES}
    share = spent[EDGES] / max(1e-9, sum(spent.values()))
    return f"The edges are {100.0 * share:.0f} % of the processor time; they run on the same cores as the twin."


def document(scale: FleetScale, alone: FleetRun, whole: FleetRun) -> dict[str, Any]:
    """Make the content of the JSON file."""
    return {
        "lines": [line._asdict() for line in lines(scale, alone, whole)],
        "samples": [
            {"time_s": one.time, "waiting": one.waiting, "age_s": one.age, **_sizes(one.used)}
            for one in whole.watch.samples
        ],
    }


def _sizes(used: dict[str, Any]) -> dict[str, float]:
    memory = {f"{role}_bytes": one.memory for role, one in used.items()}
    return {**memory, **{f"{role}_cpu_s": one.cpu for role, one in used.items()}}


def _within(times: Sequence[float], servos: int) -> str:
    return ", ".join(f"{100.0 * sum(at <= until for at in times) / servos:.4g}" for until in WITHIN_S) + " %"


def _cores(ran: FleetRun) -> str:
    return ", ".join(f"{ran.watch.cores(role):.2f}" for role in ROLES)


def _numbers(unit: str, *values: float) -> str:
    return ", ".join(f"{value:.3g}" for value in values) + f" {unit}"
