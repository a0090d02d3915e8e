"""`servotwin demo`: a machine wears out alone, by the paper's rule, and with its twin, side by side."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

import servotwin as st
from servotwin.cli.demo_case import PAPER, Case, Column, paper_case, scenario_case
from servotwin.cli.demo_runs import Comparison, DemoRun, DemoStep, left
from servotwin.cli.demo_sent import sent_heads, sent_texts
from servotwin.cli.loop_report import of_settings, refusals
from servotwin.errors import InvalidInput
from servotwin.plant.display_units import DisplayUnit, command_unit, position_unit
from servotwin.plant.plants import Plant
from servotwin.report import style
from servotwin.report.page import page
from servotwin.reproduction.figures import wear_panels
from servotwin.reproduction.measures import BAND, SETTLED, MeasuredStep
from servotwin.reproduction.twin_runs import EstimateRecord
from servotwin.runtime import files

NAME = "demo"
_MOST_ROWS = 24  # of the terminal's table
# Digits below the leading one of the reference's amplitude, or of the last gap.
_SWING, _LEFT, _GAP = 3, 4, 3


def demo(out: Path, preset: str = "paper", console: Console | None = None, scenario: Path | None = None) -> Path:
    """Run a machine that wears alone and with its twin, show the verdicts, and write the report.

    Parameters
    ----------
    out : Path
        Directory for report.html, demo.svg and demo.png; created if missing.
    preset : str
        Name of one of the paper's servos.
    console : Console, optional
        Where progress and verdicts are shown.
    scenario : Path, optional
        Another machine's, with its wear and its twin: a TOML file, or the name of a packaged one.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    InvalidInput
        An unknown preset, a scenario without steps, wear or twin, a directory that cannot be written.
    """
    if scenario is not None and preset != PAPER:
        raise InvalidInput(
            f"--preset {preset!r}: is of the paper's servo, and {scenario} has its own machine; leave it out"
        )
    console = console or Console()
    case = paper_case(preset) if scenario is None else _read(scenario, console)
    files.make_directory(out)
    comparison = compare(case, console)
    rows = demo_steps(comparison)
    _print_steps(comparison, rows, console)
    with style.look():
        vector = style.save(plot(comparison), out, NAME)
    path = files.write_text(out / "report.html", _report(comparison, rows, vector.read_bytes()))
    console.print(f"report: {path}", soft_wrap=True, highlight=False)
    return path


def _read(scenario: Path, console: Console) -> Case:
    with console.status("looking for a verified fallback set"):
        return scenario_case(scenario)


def compare(case: Case, console: Console) -> Comparison:
    """Run all in parallel, under progress bars; an interrupt ends them."""
    percent, note = TextColumn("{task.percentage:3.0f} %"), TextColumn("[dim]{task.fields[note]}")
    ended = threading.Event()
    with (
        Progress(TextColumn("{task.description:<18}"), BarColumn(), percent, note, console=console) as progress,
        ThreadPoolExecutor(len(case.columns)) as pool,
    ):

        def progress_bar(column: Column) -> Callable[[float], None]:
            bar = progress.add_task(
                column.name, total=1.0, note="the first run ever compiles" if column is case.twinned else ""
            )

            def show(share: float) -> None:
                if ended.is_set():
                    raise KeyboardInterrupt
                progress.update(bar, completed=share, note="")

            return show

        runs = [pool.submit(_run, case, column, progress_bar(column)) for column in case.columns]
        try:
            alone, *published, twinned = (each.result() for each in runs)
        except BaseException:
            ended.set()
            raise
    return Comparison(case, alone, published[0] if published else None, twinned)


def _run(case: Case, column: Column, progress: Callable[[float], None]) -> DemoRun:
    loop = st.cosimulate(column.scenario, progress)
    return DemoRun(column, loop, case.trace(loop.run))


def demo_steps(comparison: Comparison) -> list[DemoStep]:
    """One row per step; the estimates are those of windows whose middle lies in it."""
    twinned, published = comparison.twinned, comparison.published
    return [
        DemoStep(number, each, twinned.estimate(each[-1]), None if published is None else published.estimate(each[-1]))
        for number, each in enumerate(zip(*(one.steps for one in comparison.runs), strict=True), start=1)
    ]


def plot(comparison: Comparison) -> Figure:
    """Position of each run, gap and estimates."""
    case = comparison.case
    figure, panels = wear_panels.sheet(len(comparison.runs) + 1, case.scenario.duration)
    for axes, each in zip(panels, comparison.runs, strict=False):
        name = f"position{'' if each is comparison.alone else ','} {each.column.name}"
        wear_panels.position(axes, each.trace, name, comparison.unit)
    wear_panels.true_gap(panels[-1], comparison.twinned.trace)
    wear_panels.estimates(panels[-1], comparison.twinned.estimates)
    style.legend(panels[-1])
    if not case.paper:
        _at_load(panels[-1], case.scenario.servo)
    return figure


def _at_load(axes: Axes, servo: Plant) -> None:
    """Show the gap as the travel of the load that it is, on the right."""
    small = position_unit(servo).small
    per_degree = small.factor * math.radians(servo.p)
    scales = partial(np.multiply, per_degree), partial(np.multiply, 1.0 / per_degree)
    axes.secondary_yaxis("right", scales).set_ylabel(f"at the load ({small.name})")


def heads(comparison: Comparison) -> tuple[str, ...]:
    """Make the heads of the table of steps."""
    unit, small, names = comparison.unit.name, _small(comparison).name, [each.column.head for each in comparison.runs]
    if not comparison.case.paper:
        return "step", "gap, deg", "estimate, deg", *(f"{name}, {small}" for name in names)
    return "step", "gap, deg", "estimate, deg", *(f"{name}, {unit}" for name in names), f"off by, {small}"


def cells(comparison: Comparison, row: DemoStep) -> tuple[str, ...]:
    """Make the texts of a row, in the order of `heads`: verdicts, with the swing in the paper's, or the error left."""
    first = str(row.number), _degrees(comparison, row.gap), _estimate(comparison, row.estimate)
    if not comparison.case.paper:
        return *first, *(f"{_verdict(comparison, step)} {_fine(comparison, left(step))}" for step in row.steps)
    swings = (f"{_verdict(comparison, step)} {_swing(comparison, step)}" for step in row.steps)
    return *first, *swings, _fine(comparison, row.left)


def _swing(comparison: Comparison, step: MeasuredStep) -> str:
    unit = comparison.unit
    return _fixed(step.amplitude * unit.factor, comparison.settling.scale * unit.factor, _SWING)


def _fine(comparison: Comparison, length: float) -> str:
    """A small length or angle, in the thousandth of the unit."""
    small = _small(comparison)
    return _fixed(length * small.factor, comparison.settling.scale * small.factor, _LEFT)


def _small(comparison: Comparison) -> DisplayUnit:
    return position_unit(comparison.case.scenario.servo).small


def _degrees(comparison: Comparison, gap: float) -> str:
    """A gap in degrees, with the digits that the last one of the run needs."""
    return _fixed(math.degrees(gap), math.degrees(float(comparison.twinned.trace.gap[-1])), _GAP)


def _fixed(value: float, scale: float, digits: int) -> str:
    """A number with so many digits below the leading one of `scale`."""
    return f"{value:.{max(0, digits - math.floor(math.log10(scale) + 1e-9))}f}"


def _estimate(comparison: Comparison, one: EstimateRecord | None) -> str:
    if one is None:
        return "-"
    return _degrees(comparison, one.gap) if one.ok else "refused"


def _verdict(comparison: Comparison, step: MeasuredStep) -> str:
    """Verdict on a step: it rests, or the paper's servo swings; another machine may be on its way still."""
    return "rests" if step.settled else "swings" if comparison.case.paper else "moves"


def summary(comparison: Comparison, rows: Sequence[DemoStep]) -> tuple[str, ...]:
    """Sentences on the machine and on the estimates."""
    first, *others = (sum(row.steps[place].settled for row in rows) for place in range(len(comparison.runs)))
    names = (each.column.name for each in comparison.runs[1:])
    more = ", ".join(f"with the {name} {count}" for name, count in zip(names, others, strict=True))
    machine = f"Without a twin {first} of {len(rows)} steps settle, {more}."
    accuracy = _accuracy(comparison.twinned.estimates)
    return (machine, accuracy) if comparison.case.paper else (machine, _medians(comparison), accuracy)


def _medians(comparison: Comparison) -> str:
    """Error and time of a step in the median, with each controller."""
    small, parts = _small(comparison), list[str]()
    for each in comparison.runs:
        time = median(step.settling_time for step in each.steps)
        error = small.text(median(left(step) for step in each.steps), ".3g")
        parts.append(f"{each.column.head} {error}, {f'{time:.3g} s' if math.isfinite(time) else 'not by then'}")
    what = f"Median error at the end of a step, and time until {100 * BAND:g} % of the step remain to that end"
    return f"{what}: {'; '.join(parts)}."


def _accuracy(estimates: Sequence[EstimateRecord]) -> str:
    """Number of estimates, and their largest error."""
    errors = [abs(math.degrees(one.error)) for one in estimates if one.ok]
    inside = sum(one.ok and one.interval[0] <= one.truth <= one.interval[1] for one in estimates)
    intervals = f"; the gap lies in {inside} of {len(errors)} intervals of 95 %"
    worst = f", off by {max(errors):.2g} deg at most{intervals}" if errors else ""
    return f"Estimates from {len(errors)} of {len(estimates)} windows{worst}."


def definition(comparison: Comparison) -> str:
    """Definition of settled."""
    settling, unit = comparison.settling, comparison.unit
    share, length = f"{100 * SETTLED:g} % of {unit.text(settling.scale, '.4g')}", f"{settling.tail:.4g} s"
    counts = " and two counts of the sensor" if settling.floor else ""
    beside = "" if comparison.case.paper else " Otherwise it moves. Beside stands the largest error within that time."
    return (
        f"A step settles, and rests, when its swing, half the peak-to-peak over the last {length}, is below "
        f"{share}{counts}.{beside}"
    )


def _print_steps(comparison: Comparison, rows: Sequence[DemoStep], console: Console) -> None:
    table = Table(*(head.replace(", ", "\n") for head in heads(comparison)), box=None, pad_edge=False)
    every = -(-len(rows) // _MOST_ROWS)
    for row in rows[::every]:
        table.add_row(*(_colored(cell) for cell in cells(comparison, row)))
    console.print(table, highlight=False)
    if every > 1:
        console.print(f"One step in {every} is shown; the report has all.", style="dim", highlight=False)
    for sentence in (*summary(comparison, rows), *_remarks(comparison)):
        console.print(sentence, highlight=False, markup=False)
    console.print(definition(comparison), style="dim", highlight=False)


def _remarks(comparison: Comparison) -> list[str]:
    """Sentences on windows that the twin refused, on what it sent, and on a run that is left out."""
    loop, left_out = comparison.twinned.loop, comparison.case.left_out
    return [*refusals(loop), *of_settings(loop), *([left_out] if left_out else [])]


def _colored(cell: str) -> str:
    for start, color in (("rests", "green"), ("swings", "red"), ("moves", "red")):
        cell = cell.replace(start, f"[{color}]{start}[/]")
    return cell


def _report(comparison: Comparison, rows: Sequence[DemoStep], vector: bytes) -> str:
    case, published = comparison.case, comparison.published
    law, updates, small = case.scenario.servo.controller, comparison.twinned.loop.updates, _small(comparison)
    columns = sent_heads(updates, law, command_unit(case.scenario.servo), small)
    others = [_others(comparison, row) for row in rows]
    return page(
        "demo.html",
        case.title,
        summary=" ".join(summary(comparison, rows)),
        definition=definition(comparison),
        picture=vector,
        caption=_caption(comparison),
        heads=(*heads(comparison), *_other_heads(comparison)),
        steps=[(*map(_unbroken, cells(comparison, row)), *more) for row, more in zip(rows, others, strict=True)],
        published="" if published is None else f"The {published.column.name}: {_lower(_accuracy(published.estimates))}",
        twin=comparison.twinned.column.name,
        paper=case.paper,
        remarks=_remarks(comparison),
        sent_heads=columns,
        sent=[sent_texts(update, columns, law, small) for update in updates],
    )


def _unbroken(cell: str) -> str:
    return cell.replace(" ", "\N{NO-BREAK SPACE}")


def _other_heads(comparison: Comparison) -> tuple[str, ...]:
    """Heads of the columns that the terminal has no room for."""
    published = comparison.published
    more = () if published is None else (f"{published.column.head}: estimate, deg",)
    if comparison.case.paper:
        return more
    return *(f"{each.column.head}: swing, {_small(comparison).name}" for each in comparison.runs), *more


def _others(comparison: Comparison, row: DemoStep) -> tuple[str, ...]:
    more = () if comparison.published is None else (_estimate(comparison, row.published_estimate),)
    return more if comparison.case.paper else (*(_fine(comparison, step.amplitude) for step in row.steps), *more)


def _caption(comparison: Comparison) -> str:
    """Description of the panels."""
    words = [each.column.explained for each in comparison.runs]
    words.append(
        f"the gap and the {comparison.twinned.column.name}'s estimates, and as a cross what it knew before a "
        "window that it refused"
    )
    panels = "; ".join(f"({letter}) {each}" for letter, each in zip("abcd", words, strict=False))
    return f"{comparison.case.story} {panels}."


def _lower(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]
