"""`servotwin demo`: Fig 15's servo wears out twice, once alone and once with its twin, side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

import servotwin as st
from servotwin import outputs
from servotwin.reproduce import page
from servotwin.reproduce.figures import style, worn
from servotwin.reproduce.loops import LoopJob, Record, record
from servotwin.reproduce.measures import SETTLED, TAIL, Step

MM = 1e3
NAME = "demo"
TITLE = "A worn servo, alone and with its twin"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Both runs, the servo, and the names of their columns."""

    servo: st.Servo
    alone: Record
    twinned: Record


@dataclass(frozen=True)
class Verdict:
    """One step, alone and with the twin; angles in rad, lengths in m."""

    number: int
    gap: float
    alone: Step
    twinned: Step
    estimate: float
    tolerance: float


def demo(out: Path, preset: str = "paper", console: Console | None = None) -> Path:
    """Run both, show the verdicts, and write the report.

    Parameters
    ----------
    out : Path
        Directory for report.html, demo.svg and demo.png; made if missing.
    preset : str
        Which of the paper's servos.
    console : Console, optional
        Where progress and verdicts are shown.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    InvalidInput
        An unknown preset, a directory that cannot be written.
    """
    console = console or Console()
    scenario = LoopJob(preset).described()
    outputs.make_directory(out)
    found = compare(scenario, console)
    rows = verdicts(found)
    _tell(rows, console)
    with style.look():
        vector = style.save(plot(found), out, NAME)
    path = outputs.write_text(out / "report.html", _report(rows, vector.read_bytes(), preset))
    console.print(f"report: {path}", soft_wrap=True, highlight=False)
    return path


def compare(scenario: st.Scenario, console: Console) -> Comparison:
    """The scenario with its twin switched off and on, under progress bars."""
    percent, note = TextColumn("{task.percentage:3.0f} %"), TextColumn("[dim]{task.fields[note]}")
    with Progress(TextColumn("{task.description:<16}"), BarColumn(), percent, note, console=console) as progress:

        def watched(name: str, note: str) -> Callable[[float], None]:
            bar = progress.add_task(name, total=1.0, note=note)
            return lambda share: progress.update(bar, completed=share, note="")

        alone, twinned = watched("without the twin", "the first run ever compiles"), watched("with the twin", "")
        off = scenario.replace(twin=scenario.twin.replace(enabled=False))
        return Comparison(scenario.servo, record(off, progress=alone), record(scenario, progress=twinned))


def verdicts(found: Comparison) -> list[Verdict]:
    """One row per step; the estimate is the one from that step's window, the tolerance the last in force."""
    trace = found.twinned.trace
    ends = [int(trace.time.searchsorted(step.end)) - 1 for step in trace.steps]
    parts = zip(found.alone.trace.steps, trace.steps, found.twinned.estimates, ends, strict=True)
    return [
        Verdict(i, estimate.truth, alone, twinned, estimate.gap, float(trace.tolerance[end]))
        for i, (alone, twinned, estimate, end) in enumerate(parts, start=1)
    ]


def plot(found: Comparison) -> Figure:
    """Position alone, position with the twin, gap and estimates."""
    figure, (upper, middle, lower) = worn.sheet(3)
    worn.position(upper, found.alone.trace, "position without the twin")
    worn.position(middle, found.twinned.trace, "position with the twin")
    worn.gaps(lower, found.twinned, found.servo.p)
    style.legend(lower)
    return figure


HEADS = ("step", "gap, deg", "estimate, deg", "dead zone, mm", "alone: swing, mm", "with twin: swing, mm", "bias, mm")


def cells(row: Verdict) -> tuple[str, ...]:
    """A verdict as texts, in the order of `HEADS`."""
    return (
        str(row.number),
        f"{math.degrees(row.gap):.2f}",
        f"{math.degrees(row.estimate):.2f}",
        f"±{row.tolerance * MM:.3f}",
        f"{word(row.alone)} {row.alone.amplitude * MM:.3f}",
        f"{word(row.twinned)} {row.twinned.amplitude * MM:.3f}",
        f"{row.twinned.bias * MM:+.3f}",
    )


def word(step: Step) -> str:
    """Whether a step came to rest."""
    return "settled" if step.settled else "oscillates"


def summary(rows: Sequence[Verdict]) -> str:
    """One sentence."""
    alone, twinned = (
        sum(step.settled for step in steps) for steps in ([r.alone for r in rows], [r.twinned for r in rows])
    )
    return f"Without the twin {alone} of {len(rows)} steps settle, with it {twinned}."


def definition() -> str:
    """What settled means."""
    share, length = f"{100 * SETTLED:g} % of 1 mm", f"{TAIL:g} s"
    return f"Settled: the swing, half the peak-to-peak over the last {length} of the step, is below {share}."


def _tell(rows: Sequence[Verdict], console: Console) -> None:
    table = Table(*(head.replace(", ", "\n") for head in HEADS), box=None, pad_edge=False)
    for row in rows:
        table.add_row(*(_colored(cell) for cell in cells(row)))
    console.print(table, highlight=False)
    console.print(summary(rows), highlight=False)
    console.print(definition(), style="dim", highlight=False)


def _colored(cell: str) -> str:
    for start, color in (("settled", "green"), ("oscillates", "red")):
        cell = cell.replace(start, f"[{color}]{start}[/]")
    return cell


def _report(rows: Sequence[Verdict], vector: bytes, preset: str) -> str:
    caption = (
        f"Preset {preset}: a square wave of ±1 mm while the gap wears from 0 to 20 deg in 200 s. (a) No dead zone;"
        " (b) the twin estimates the gap from 1 s of samples after each step, and its dead zone takes effect 3 s after"
        " the step; (c) the gap, the estimates and the gap that the dead zone in force is made for."
    )
    return page.page(
        TITLE,
        [
            f"<h1>{escape(TITLE)}</h1>",
            f"<p><strong>{escape(summary(rows))}</strong> {escape(definition())}</p>",
            page.figure(vector, "The same servo twice.", caption),
            "<h2>Step by step</h2>",
            page.table(HEADS, [cells(row) for row in rows]),
            "<p class='soft small'>Every figure and claim of the paper: <code>servotwin reproduce</code>.</p>",
        ],
    )
