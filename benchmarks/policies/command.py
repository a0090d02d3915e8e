"""`servotwin bench policies`: the policies side by side on random machines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.policies.machines import BLOCKS
from benchmarks.policies.table import PolicyScores, compare
from benchmarks.policies.trial import Scores
from servotwin.analysis.maps.pool import workplace
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.uncertainty import Uncertainty

SCHEMA = "servotwin-bench-policies/1"
NAME = "policies"
MACHINES, QUICK = 500, 20
STATED = Uncertainty(input_bias=(-0.1, 0.1))
# Heading, measure, percentile, unit's factor, digits.
_COLUMNS = (
    ("tail p95\nmm", "tail", 95.0, 1e3, 4),
    ("cost med\ns", "cost", 50.0, 1.0, 2),
    ("cost p95\ns", "cost", 95.0, 1.0, 2),
    ("overshoot\np95 %", "overshoot", 95.0, 100.0, 0),
    ("settling\np95 s", "settling", 95.0, 1.0, 1),
    ("voltage\np95 V", "voltage", 95.0, 1.0, 4),
    ("travel\np95 rad/s", "travel", 95.0, 1.0, 4),
    ("position\np95 um", "position", 95.0, 1e6, 2),
)
_BINS = (0.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)


def policies(
    date: str = "",
    output: Path | None = None,
    count: int = MACHINES,
    blocks: Sequence[str] = BLOCKS,
    console: Console | None = None,
) -> tuple[PolicyScores, ...]:
    """Compare, show as it comes, and write JSON if `output` is given.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    count : int
        Machines of each block.
    blocks : sequence of str
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written.
    """
    console = console or Console()
    report.check(output)
    rows = []
    with console.status("simulating") as status, workplace():
        for row in compare(Servo.preset("paper"), STATED, count, blocks=blocks):
            rows.append(row)
            status.update(f"simulating, {row.block} block: {row.name} is done")
    console.print(shown(rows))
    console.print(chosen(rows))
    report.write(output, dumps(rows, date), console)
    return tuple(rows)


def shown(rows: Sequence[PolicyScores]) -> Table:
    """A line for each contender in each block."""
    result = Table(title="policies: random machines, 60 s after a step", title_justify="left", box=None, pad_edge=False)
    result.add_column("block")
    result.add_column("policy")
    for heading in ("settled\n%", *(column[0] for column in _COLUMNS)):
        result.add_column(heading, justify="right")
    for row in rows:
        numbers = (f"{factor * row.at(name, at):.{digits}f}" for _, name, at, factor, digits in _COLUMNS)
        result.add_row(row.block, row.name, f"{100.0 * row.settled:.1f}", *numbers)
    return result


def chosen(rows: Sequence[PolicyScores]) -> Table:
    """Settings that the certified policy had in force at the end, by gap."""
    result = Table(title="certified: in force at the end", title_justify="left", box=None, pad_edge=False)
    for heading in ("block", "gap, deg", "machines", "Kp, Kd x", "with Ki, %", "with dead zone, %"):
        result.add_column(heading, justify="left" if heading == "block" else "right")
    for row in rows:
        for low, high in pairwise(_BINS) if row.name == "certified" else ():
            gap = np.degrees([machine.gap for machine in row.machines])
            inside = (gap >= low) & (gap < high)
            if inside.any():
                result.add_row(row.block, f"{low:g} .. {high:g}", str(int(inside.sum())), *_choice(row.scores, inside))
    return result


def _choice(scores: Scores, which: NDArray[np.bool_]) -> tuple[str, str, str]:
    scale, integral, width = (np.asarray(values)[which] for values in scores[-3:])
    ends = np.percentile(scale, [10.0, 50.0, 90.0])
    return (
        f"{ends[1]:.2f} ({ends[0]:.2f} .. {ends[2]:.2f})",
        f"{100.0 * np.mean(integral > 0.0):.0f}",
        f"{100.0 * np.mean(width > 0.0):.0f}",
    )


def dumps(rows: Sequence[PolicyScores], date: str) -> str:
    """The document: schema, date, machine, and every measure of every run."""
    table = [
        {
            "block": row.block,
            "policy": row.name,
            "gap_deg": [round(math.degrees(machine.gap), 6) for machine in row.machines],
            **{name: [float(v) for v in values] for name, values in row.scores._asdict().items()},
        }
        for row in rows
    ]
    return report.text(SCHEMA, date, rows=table)
