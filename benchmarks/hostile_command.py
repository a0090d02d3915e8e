"""`servotwin bench hostile`: measure that the loop stays in its certified band with hostile twins."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks import hostile, report
from benchmarks.hostile import HostileOutcome
from benchmarks.hostiletwin import TwinFault
from servotwin.analysis.maps.pool import shared, workplace

SCHEMA = "servotwin-bench-hostile/1"
NAME = "hostile"
MACHINES, QUICK = 200, 8
FRICTION_SHARE = 5  # for so many machines one more, with friction
FRICTION = "any, and friction"
HEADS = ("twin", "machines", "worst, bands", "outside", "updates applied", "fell back")

HostileTask = tuple[int, TwinFault, bool]
"""Seed, fault of the twin, and friction."""


def hostile_twins(
    date: str = "",
    output: Path | None = None,
    count: int = MACHINES,
    kinds: Sequence[TwinFault] = hostile.KINDS,
    console: Console | None = None,
) -> tuple[HostileOutcome, ...]:
    """Let machines endure hostile twins, print the outcomes, and write JSON on request.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    count : int
        Machines within the stated range; the kinds of twins take turns. A fifth as many more have friction.
    kinds : sequence of TwinFault
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    tasks = [(seed, kinds[seed % len(kinds)], False) for seed in range(count)]
    tasks += [(seed, kinds[seed % len(kinds)], True) for seed in range(count // FRICTION_SHARE)]
    with workplace(), warnings.catch_warnings():
        # A process whose caches have grown is replaced by another; its jobs are not lost.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)
        running = track(shared(endured, tasks), "enduring", len(tasks), console=console, transient=True)
        result = dict(running)
    outcomes = tuple(result[task] for task in tasks)
    console.print(shown(outcomes))
    console.print(verdict(outcomes), highlight=False)
    report.write(output, dumps(outcomes, date), console)
    return outcomes


def endured(task: HostileTask) -> HostileOutcome:
    """Run one machine with its twin."""
    seed, kind, friction = task
    return hostile.endured(seed, kind, friction=friction)


def verdict(outcomes: Sequence[HostileOutcome]) -> str:
    """Sum up all outcomes in one sentence."""
    stated = [outcome for outcome in outcomes if not outcome.case.friction]
    band, inside = hostile.band(), sum(outcome.worst <= 1.0 for outcome in stated)
    limit = f"{band.error * 1e3:.3f} mm from {band.settling:g} s after each step on"
    return f"{inside} of {len(stated)} machines as stated stay within {limit}."


def shown(outcomes: Sequence[HostileOutcome]) -> Table:
    """A row for each kind of twin, and one for machines with friction."""
    result = Table(title="hostile: what the edge endures", title_justify="left", box=None, pad_edge=False)
    for head in HEADS:
        result.add_column(head, justify="left" if head == HEADS[0] else "right")
    for row in dict.fromkeys(map(_row, outcomes)):
        some = [outcome for outcome in outcomes if _row(outcome) == row]
        numbers = f"{max(o.worst for o in some):.2f}", sum(o.worst > 1.0 for o in some), sum(o.applied for o in some)
        result.add_row(row, str(len(some)), *map(str, numbers), str(sum(bool(o.fallbacks) for o in some)))
    return result


def _row(outcome: HostileOutcome) -> str:
    return FRICTION if outcome.case.friction else outcome.kind.value


def dumps(outcomes: Sequence[HostileOutcome], date: str) -> str:
    """The document: schema, date, machine, band, and every outcome."""
    band = hostile.band()
    rows = [
        {
            "twin": outcome.kind.value,
            "friction_n_m": outcome.case.friction,
            "worst_bands": outcome.worst,
            "outside_s": outcome.outside,
            "recovered": outcome.recovered,
            "applied": outcome.applied,
            "fallbacks": [cause.value for cause in outcome.fallbacks],
            "refused": {reason.value: number for reason, number in sorted(outcome.refused.items())},
        }
        for outcome in outcomes
    ]
    limits = {"error_m": band.error, "settling_s": band.settling}
    return report.text(SCHEMA, date, band=limits, outcomes=rows)
