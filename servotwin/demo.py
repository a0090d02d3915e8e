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
from servotwin.reproduce.loops import OURS, Estimated, LoopJob, Record, record
from servotwin.reproduce.measures import SETTLED, TAIL, Step

MM = 1e3
NAME = "demo"
TITLE = "A worn servo, alone and with its twin"


@dataclass(frozen=True, eq=False)
class Comparison:
    """The servo, alone, with its twin, and with the twin as published."""

    servo: st.Servo
    alone: Record
    twinned: Record
    published: Record


@dataclass(frozen=True)
class Verdict:
    """One step, alone, with the twin and with the published one; the estimates of the twins; the dead zone, m."""

    number: int
    alone: Step
    twinned: Step
    published: Step
    estimate: Estimated
    published_estimate: Estimated
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
    scenario = LoopJob(preset, method=OURS).described()
    outputs.make_directory(out)
    found = compare(scenario, LoopJob(preset).described(), console)
    rows = verdicts(found)
    _tell(rows, console)
    with style.look():
        vector = style.save(plot(found), out, NAME)
    path = outputs.write_text(out / "report.html", _report(rows, vector.read_bytes(), preset))
    console.print(f"report: {path}", soft_wrap=True, highlight=False)
    return path


def compare(scenario: st.Scenario, published: st.Scenario, console: Console) -> Comparison:
    """The scenario with its twin switched off and on, and the published one, under progress bars."""
    percent, note = TextColumn("{task.percentage:3.0f} %"), TextColumn("[dim]{task.fields[note]}")
    with Progress(TextColumn("{task.description:<18}"), BarColumn(), percent, note, console=console) as progress:

        def watched(name: str, note: str = "") -> Callable[[float], None]:
            bar = progress.add_task(name, total=1.0, note=note)
            return lambda share: progress.update(bar, completed=share, note="")

        off = scenario.replace(twin=scenario.twin.replace(enabled=False))
        names = ("without the twin", "with the twin", "twin as published")
        shown = [watched(name, "the first run ever compiles" if name == names[0] else "") for name in names]
        runs = (record(each, progress=bar) for each, bar in zip((off, scenario, published), shown, strict=True))
        return Comparison(scenario.servo, *runs)


def verdicts(found: Comparison) -> list[Verdict]:
    """One row per step; the estimates are those from that step's window, the tolerance the last in force."""
    trace = found.twinned.trace
    ends = [int(trace.time.searchsorted(step.end)) - 1 for step in trace.steps]
    steps = zip(found.alone.trace.steps, trace.steps, found.published.trace.steps, strict=True)
    estimates = zip(found.twinned.estimates, found.published.estimates, strict=True)
    parts = enumerate(zip(steps, estimates, ends, strict=True), start=1)
    return [Verdict(i, *three, *two, float(trace.tolerance[end])) for i, (three, two, end) in parts]


def plot(found: Comparison) -> Figure:
    """Position alone, position with the twin, gap and estimates."""
    figure, (upper, middle, lower) = worn.sheet(3)
    worn.position(upper, found.alone.trace, "position without the twin")
    worn.position(middle, found.twinned.trace, "position with the twin")
    worn.gaps(lower, found.twinned, found.servo.p)
    style.legend(lower)
    return figure


HEADS = ("step", "gap, deg", "estimate, deg", "dead zone, mm", "alone: swing, mm", "with twin: swing, mm", "bias, mm")


MORE = ("published: estimate, deg", "swing, mm")


def more(row: Verdict) -> tuple[str, ...]:
    """The same of the published twin, in the order of `MORE`."""
    return _estimate(row.published_estimate), f"{word(row.published)} {row.published.amplitude * MM:.3f}"


def cells(row: Verdict) -> tuple[str, ...]:
    """A verdict as texts, in the order of `HEADS`."""
    return (
        str(row.number),
        f"{math.degrees(row.estimate.truth):.2f}",
        _estimate(row.estimate),
        f"±{row.tolerance * MM:.3f}",
        f"{word(row.alone)} {row.alone.amplitude * MM:.3f}",
        f"{word(row.twinned)} {row.twinned.amplitude * MM:.3f}",
        f"{row.twinned.bias * MM:+.3f}",
    )


def _estimate(one: Estimated) -> str:
    return f"{math.degrees(one.gap):.2f}" if one.ok else "refused"


def word(step: Step) -> str:
    """Whether a step came to rest."""
    return "settled" if step.settled else "oscillates"


def summary(rows: Sequence[Verdict]) -> tuple[str, str]:
    """One sentence on the servo, one on the estimates."""
    alone, twinned = (sum(getattr(row, name).settled for row in rows) for name in ("alone", "twinned"))
    settled = f"Without the twin {alone} of {len(rows)} steps settle, with it {twinned}."
    return settled, _accuracy([row.estimate for row in rows])


def comparison(rows: Sequence[Verdict]) -> tuple[str, str]:
    """What the published estimator makes of the same servo."""
    settled = sum(row.published.settled for row in rows)
    said = f"With the estimator as published, in the same loop, {settled} of {len(rows)} steps settle."
    return said, _accuracy([row.published_estimate for row in rows])


def _accuracy(estimates: Sequence[Estimated]) -> str:
    """How many estimates were made, and how far they are off at most."""
    errors = [abs(math.degrees(one.error)) for one in estimates if one.ok]
    worst = f", off by {max(errors):.2g} deg at most" if errors else ""
    return f"Estimates from {len(errors)} of {len(estimates)} windows{worst}."


def definition() -> str:
    """What settled means."""
    share, length = f"{100 * SETTLED:g} % of 1 mm", f"{TAIL:g} s"
    return f"Settled: the swing, half the peak-to-peak over the last {length} of the step, is below {share}."


def _tell(rows: Sequence[Verdict], console: Console) -> None:
    table = Table(*(head.replace(", ", "\n") for head in HEADS), box=None, pad_edge=False)
    for row in rows:
        table.add_row(*(_colored(cell) for cell in cells(row)))
    console.print(table, highlight=False)
    for sentence in (*summary(rows), *comparison(rows)):
        console.print(sentence, highlight=False)
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
            f"<p><strong>{escape(' '.join(summary(rows)))}</strong> {escape(definition())}</p>",
            f"<p>{escape(' '.join(comparison(rows)))}</p>",
            page.figure(vector, "The same servo twice.", caption),
            "<h2>Step by step</h2>",
            page.table((*HEADS, *MORE), [(*cells(row), *more(row)) for row in rows]),
            "<p class='soft small'>Every figure and claim of the paper: <code>servotwin reproduce</code>.</p>",
        ],
    )
