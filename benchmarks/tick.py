"""`servotwin bench tick`: speed and regularity of the edge's control loop, and the limits of this system."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks import report
from benchmarks.report import cores

SCHEMA = "servotwin-bench-tick/1"
NAME = "tick"
SECONDS, QUICK = 30.0, 2.0
RATES = (1000.0, 5000.0)
PRIORITY = 50
_TIMES = {"answer": "tick", "whole": "whole", "wake": "wake-up"}
_SHARES = ("median_us", "p99_us", "p999_us", "max_us")

Case = tuple[float, bool, bool]
"""Rate (Hz), whether windows are cut all the time, and whether the process asks for real-time priority."""


def ticks(date: str = "", output: Path | None = None, seconds: float = SECONDS, console: Console | None = None) -> None:
    """Measure every case, show, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    seconds : float
        Length of each run.
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    cases = [(rate, busy, hurried) for hurried in (False, True) for rate in RATES for busy in (False, True)]
    runs = [measured(case, seconds) for case in track(cases, "ticking", console=console, transient=True)]
    console.print(shown(runs))
    for line in summary_lines(runs):
        console.print(line, highlight=False, soft_wrap=True)
    report.write(output, report.text(SCHEMA, date, seconds=seconds, runs=runs), console)


def measured(case: Case, seconds: float) -> dict[str, Any]:
    """Run one case in a process that imports only what an edge does."""
    rate, busy, hurried = case
    priority = PRIORITY if hurried else 0
    with tempfile.TemporaryDirectory() as folder:
        arguments = [str(rate), str(seconds), str(int(busy)), str(priority), folder]
        command = [sys.executable, "-m", "benchmarks.tickloop", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def shown(runs: Sequence[dict[str, Any]]) -> Table:
    """A row for each run and kind of time, in microseconds."""
    result = Table(title="tick: the edge's control loop, µs", title_justify="left", box=None, pad_edge=False)
    for head in ("kHz", "priority", "windows", "time", "median", "p99", "p99.9", "max", "overruns", "missed"):
        result.add_column(head, justify="left" if head in ("priority", "time") else "right")
    for run in runs:
        first = f"{run['rate_hz'] / 1e3:g}", "real-time" if run["realtime"] else "normal", str(run["windows"])
        last = str(run["overruns"]), str(run["missed"])
        for key, name in _TIMES.items():
            ends = (first, last) if key == "answer" else (("", "", ""), ("", ""))
            result.add_row(*ends[0], name, *(f"{run[key][share]:.0f}" for share in _SHARES), *ends[1])
    return result


def summary_lines(runs: Sequence[dict[str, Any]]) -> list[str]:
    """Explain the columns and their limits."""
    slowest = max(runs, key=lambda run: (run["rate_hz"], -run["pack_s"]))
    handling = f"{slowest['pack_s'] * 1e3:.1f} ms to pack and {slowest['put_s'] * 1e3:.1f} ms to put on disk"
    realtime = "" if any(run["realtime"] for run in runs) else " (not allowed here)"
    load = max(run["load"] for run in runs)
    return [
        "tick: from the sample to its voltage; whole: until the loop waits again, agent, watch and pipe included; "
        "wake-up: how late the loop gets its sample from a sleeping drive, where a normal process has 50 µs of timer "
        "slack; overruns: the whole took longer than a period; missed: samples whose instant went by.",
        f"A window of 1 s at {slowest['rate_hz'] / 1e3:g} kHz takes the link process {handling}, beside the loop.",
        f"Limits: {platform.python_implementation()} {platform.python_version()} on {cores()} cores, load up to "
        f"{load:.1f} by others too; {_kernel()}; real-time priority is SCHED_FIFO{realtime}.",
    ]


def _kernel() -> str:
    realtime = Path("/sys/kernel/realtime")
    try:
        hard = realtime.read_text(encoding="ascii").strip() == "1"
    except OSError:
        hard = False
    return f"{platform.system()} {'with' if hard else 'without'} PREEMPT_RT"
