"""`servotwin bench`: measure, show a table, write JSON."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from benchmarks.catalogue import WORKLOADS, Options, chosen
from benchmarks.contest import Check, Workload
from benchmarks.measure import Clock, ContestantTimes, WorkloadResult, dumps, race, turns
from benchmarks.report import machine
from servotwin.runtime import files

RUNS, QUICK_RUNS = 7, 2
BLOCK = 0.1  # s that a short job is repeated for within its turn


def bench(
    names: Sequence[str] = (),
    date: str = "",
    json: Path | None = None,
    runs: int | None = None,
    options: Options | None = None,
    console: Console | None = None,
    clock: Clock = time.perf_counter,
) -> tuple[WorkloadResult, ...]:
    """Measure workloads and print a table of each.

    Parameters
    ----------
    names : sequence of str
        Of workloads; empty: all.
    date : str
        Written into the JSON.
    json : Path, optional
        File to write, suffix .json.
    runs : int, optional
        Rounds; None: 7, or 2 when quick.
    options : Options, optional
    console : Console, optional
        Where progress and tables go.
    clock : callable
        Seconds.

    Raises
    ------
    InvalidInput
        An unknown workload, an output that cannot be written, a reference that cannot be read.
    """
    options, console = options or Options(), console or Console()
    if json is not None:
        files.check_file(json, (".json",))
    workloads = [WORKLOADS[name](options) for name in chosen(names)]
    rounds = runs or (QUICK_RUNS if options.quick else RUNS)
    results = tuple(_measured(w, rounds, 0.0 if options.quick else BLOCK, clock, console) for w in workloads)
    host = machine()
    console.print(f"{host['cpu']}, {host['cores']} cores, {host['python']}", highlight=False)
    if json is not None:
        files.write_and_print(json, dumps(results, host, date, options.quick), console.print)
    return results


def _measured(workload: Workload, runs: int, block: float, clock: Clock, console: Console) -> WorkloadResult:
    """Measure one workload under a transient progress bar, then print its table."""
    with Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=console,
        transient=True,
    ) as progress:
        bar = progress.add_task(workload.name, total=turns(workload, runs))

        def notice(activity: str) -> None:
            progress.update(bar, advance=1, description=f"{workload.name}, {activity}")

        result = WorkloadResult(workload, race(workload, runs, block, clock, notice))
    console.print(table(result))
    return result


def table(result: WorkloadResult) -> Table:
    """One workload's table for the terminal."""
    workload = result.workload
    shown = Table(title=f"{workload.name}: {workload.title}", title_justify="left", box=None, pad_edge=False)
    shown.add_column("contestant")
    for heading in (
        "median",
        "ratio",
        "processor",
        "ratio",
        *(f"{check.name}\n{check.unit}" for check in workload.checks),
    ):
        shown.add_column(heading, justify="right")
    shown.add_column("notes")
    for row in result.rows:
        shown.add_row(row.name, *_numbers(result, row, workload.checks), escape(result.note(row)))
    return shown


def _numbers(result: WorkloadResult, row: ContestantTimes, checks: Sequence[Check]) -> list[str]:
    if row.missing:
        return ["-"] * (4 + len(checks))
    errors = [f"{row.errors[check.name]:.2g}" for check in checks]
    processor = [duration(median(row.processor)), figure(result.processor_ratio(row))]
    return [duration(row.median), figure(result.ratio(row)), *processor, *errors]


def figure(ratio: float) -> str:
    """Three digits, or all before the point."""
    return f"{ratio:,.0f}" if ratio >= 100.0 else f"{ratio:.3g}"


def duration(seconds: float) -> str:
    """A time with three digits and its unit."""
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{seconds * 1e3:.3g} ms"
