"""`servotwin bench windows`: estimates from corrupted windows, and a twin's of machines off their models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import TypeAlias

from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks import report
from benchmarks.corrupted import KINDS, corrupted_windows
from benchmarks.wrong_models import LOOPS, ModelError, Tally, learning_twin
from servotwin.analysis.maps.pool import shared, workplace
from servotwin.estimation import whitened
from servotwin.estimation.learning.machine import LearningSettings, nameplate

SCHEMA = "servotwin-bench-windows/1"
NAME = "windows"
WINDOWS, QUICK = 120, 4  # of a kind and a view; a twenty-fourth as many machines of a loop
SEED = 2026
EXACT, UNKNOWN, TWIN = "exact model", "first window", "twin"
RATE = math.radians(0.2)  # rad/s, of the gap within a window
ERRORS = ModelError(0.05, 0.5, 0.01, 0.1)

WindowsTask: TypeAlias = tuple[str, str, int, int]
"""View, kind or loop, number of windows or machines, seed."""


def windows(
    date: str = "",
    output: Path | None = None,
    count: int = WINDOWS,
    seed: int = SEED,
    kinds: Sequence[str] = tuple(KINDS),
    console: Console | None = None,
) -> dict[WindowsTask, Tally]:
    """Estimate every kind of window, print how many were accepted and wrong, and write JSON on request.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    count : int
        Windows of each kind, with the model taken as exact and as many as the first of a machine that is not known.
    seed : int
    kinds : sequence of str
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    tasks = [(view, kind, count, seed) for view, kind in product((EXACT, UNKNOWN), kinds)]
    tasks += [(TWIN, loop, max(2, count // 6), seed) for loop in LOOPS]
    with workplace():
        running = track(shared(counted, tasks), "estimating", len(tasks), console=console, transient=True)
        done = dict(running)
    tallies = {task: done[task] for task in tasks}
    for view in (EXACT, UNKNOWN, TWIN):
        console.print(shown(view, {task[1]: tally for task, tally in tallies.items() if task[0] == view}))
    for tally in tallies.values():
        for example in tally.examples:
            console.print(f"false: {example}", highlight=False)
    report.write(output, dumps(tallies, date), console)
    return tallies


def counted(task: WindowsTask) -> Tally:
    """Estimate the windows of a task and count."""
    view, kind, count, seed = task
    if view == TWIN:
        return learning_twin(ERRORS, kind, count, seed, steps=20)
    learning = LearningSettings()
    machine = None if view == EXACT else nameplate(learning, 0.15, 0.5, 0.1)
    settings, tally = whitened.WhitenedSettings(gap_rate=RATE), Tally()
    for case in corrupted_windows(kind, count, seed):
        tally.add(case, whitened.fit(case.window, case.servo, None, settings, machine).concluded(), late=False)
    return tally


def total(tallies: Sequence[Tally]) -> Tally:
    """Sum of tallies."""
    whole = Tally()
    for tally in tallies:
        whole.join(tally)
    return whole


HEADS = (
    "two contacts",
    "accepted",
    "after ten",
    "false",
    "worst, deg",
    "inside, %",
    "by std, %",
    "half-width, deg",
    "bounds above",
)


def shown(view: str, tallies: dict[str, Tally]) -> Table:
    """The tallies of one view as a table for the terminal."""
    table = Table(title=f"{view}: estimates accepted", title_justify="left", box=None, pad_edge=False)
    table.add_column("windows")
    for heading in ("", *HEADS):
        table.add_column(heading, justify="right")
    for name, tally in (*tallies.items(), ("all", total(list(tallies.values())))):
        table.add_row(name, *_row(tally))
    return table


def _row(tally: Tally) -> tuple[str, ...]:
    late = f"{tally.accepted_late} of {tally.two_contacts_late}" if tally.two_contacts_late else "-"
    inside = f"{100.0 * tally.coverage:.1f}" if tally.accepted else "-"
    by_std = f"{100.0 * tally.statistical:.1f}" if tally.accepted else "-"
    width = f"{math.degrees(tally.half_width):.3f}" if tally.accepted else "-"
    numbers = (tally.windows, tally.two_contacts, tally.accepted)
    return (
        *map(str, numbers),
        late,
        str(tally.false),
        f"{math.degrees(tally.worst):.3f}",
        inside,
        by_std,
        width,
        str(tally.above),
    )


def dumps(tallies: dict[WindowsTask, Tally], date: str) -> str:
    """The document: schema, date, machine, and the counts of every kind and view."""
    rows = [
        {"view": view, "kind": kind, "seed": seed, **asdict(tally)} for (view, kind, _, seed), tally in tallies.items()
    ]
    return report.text(SCHEMA, date, tallies=rows)
