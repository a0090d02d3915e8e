"""`servotwin demo`: a servo wears out alone, by the paper's rule, and with the certified twin, side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

import servotwin as st
from servotwin.errors import InvalidInput
from servotwin.messages import Update
from servotwin.plant.servo import PRESETS
from servotwin.report import style
from servotwin.report.page import page
from servotwin.reproduction.figures import wear_panels
from servotwin.reproduction.measures import SETTLED, TAIL, MeasuredStep
from servotwin.reproduction.twin_runs import EstimateRecord, TwinJob, TwinRun, run_twin
from servotwin.runtime import files

MM, UM = 1e3, 1e6
NAME = "demo"
TITLE = "A worn servo, alone and with its twin"
BIAS = 0.05  # V on the motor's input, such as an amplifier's offset


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results without a twin, with the published twin, and with the certified one."""

    servo: st.Servo
    alone: TwinRun
    published: TwinRun
    twinned: TwinRun


@dataclass(frozen=True)
class DemoStep:
    """Results of one step: without a twin, with the published twin and with the certified one, with their estimates."""

    number: int
    alone: MeasuredStep
    published: MeasuredStep
    twinned: MeasuredStep
    published_estimate: EstimateRecord
    estimate: EstimateRecord
    left: float


def demo(out: Path, preset: str = "paper", console: Console | None = None) -> Path:
    """Run all three, show the verdicts, and write the report.

    Parameters
    ----------
    out : Path
        Directory for report.html, demo.svg and demo.png; created if missing.
    preset : str
        Name of one of the paper's servos.
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
    published, certified = scenarios(preset)
    files.make_directory(out)
    comparison = compare(published, certified, console)
    rows = demo_steps(comparison)
    _print_steps(rows, console)
    with style.look():
        vector = style.save(plot(comparison), out, NAME)
    path = files.write_text(out / "report.html", _report(comparison, rows, vector.read_bytes(), preset))
    console.print(f"report: {path}", soft_wrap=True, highlight=False)
    return path


def scenarios(preset: str) -> tuple[st.Scenario, st.Scenario]:
    """The same machine with the twin as published and with the certified one."""
    if preset not in PRESETS:
        raise InvalidInput(
            f"--preset {preset!r}: the demo is of the paper's servo: give one of {', '.join(PRESETS)}; another machine "
            "is shown by servotwin simulate SCENARIO --figure run.png, or alone by enabled = false in its [twin]"
        )
    published = TwinJob(preset).scenario_to_run().replace(input_bias=BIAS)
    certified = st.Scenario.preset("certified").with_servo(published.servo)
    return published, certified.replace(input_bias=BIAS)


def compare(published: st.Scenario, certified: st.Scenario, console: Console) -> Comparison:
    """Run all three in parallel, under progress bars."""
    percent, note = TextColumn("{task.percentage:3.0f} %"), TextColumn("[dim]{task.fields[note]}")
    off = published.replace(twin=published.twin.replace(enabled=False))
    jobs = {"without a twin": off, "twin as published": published, "certified twin": certified}
    with (
        Progress(TextColumn("{task.description:<18}"), BarColumn(), percent, note, console=console) as progress,
        ThreadPoolExecutor(len(jobs)) as pool,
    ):

        def progress_bar(name: str) -> Callable[[float], None]:
            bar = progress.add_task(
                name, total=1.0, note="the first run ever compiles" if name == "certified twin" else ""
            )
            return lambda share: progress.update(bar, completed=share, note="")

        bars = [progress_bar(name) for name in jobs]
        runs = pool.map(lambda job, bar: run_twin(job, progress=bar), jobs.values(), bars)
        assert isinstance(published.servo, st.Servo)
        return Comparison(published.servo, *runs)


def demo_steps(comparison: Comparison) -> list[DemoStep]:
    """One row per step; the estimates are those from that step's window."""
    steps = zip(
        comparison.alone.trace.steps, comparison.published.trace.steps, comparison.twinned.trace.steps, strict=True
    )
    estimates = zip(comparison.published.estimates, comparison.twinned.estimates, strict=True)
    parts = enumerate(zip(steps, estimates, strict=True), start=1)
    return [DemoStep(i, *three, *two, abs(three[2].bias) + three[2].amplitude) for i, (three, two) in parts]


def plot(comparison: Comparison) -> Figure:
    """Position three times, gap and estimates."""
    figure, panels = wear_panels.sheet(4)
    names = ("position without a twin", "position, twin as published", "position, certified twin")
    for axes, each, name in zip(
        panels, (comparison.alone, comparison.published, comparison.twinned), names, strict=False
    ):
        wear_panels.position(axes, each.trace, name)
    wear_panels.true_gap(panels[-1], comparison.twinned.trace)
    wear_panels.estimates(panels[-1], comparison.twinned)
    style.legend(panels[-1])
    return figure


HEADS = (
    "step",
    "gap, deg",
    "estimate, deg",
    "alone, mm",
    "published, mm",
    "certified, mm",
    "off by, um",
)
MORE = ("published: estimate, deg",)
_SENT = ("after, s", "Kp, Kd", "Ki", "notch, Hz", "feedforward, mV", "verified on", "settled", "worst error, um", "Ms")


def cells(row: DemoStep) -> tuple[str, ...]:
    """Make the texts of a verdict, in the order of `HEADS`."""
    swings = (f"{verdict(step)} {step.amplitude * MM:.3f}" for step in (row.alone, row.published, row.twinned))
    truth = f"{math.degrees(row.estimate.truth):.2f}"
    return str(row.number), truth, _estimate(row.estimate), *swings, f"{row.left * UM:.1f}"


def sent(update: Update, servo: st.Servo) -> tuple[str, ...]:
    """Make the texts of an update, in the order of `_SENT`; gains relative to the servo's own."""
    new, verification, own = update.setting.pid, update.verification, servo.controller
    if new is None or verification is None:
        return (f"{update.data_time:.0f}", *("-" for _ in _SENT[1:]))
    gains = f"x {new.Kp / own.Kp:.2f}", f"x {new.Ki / own.Ki:.2f}"
    notch = f"{new.notch_hz:.2f}" if new.notch_hz else "-"
    worst = f"{verification.tail * UM:.1f}", f"{verification.Ms:.2f}"
    return (
        f"{update.data_time:.0f}",
        *gains,
        notch,
        f"{new.feedforward * MM:+.2f}",
        f"{verification.members} machines",
        f"{100.0 * verification.settled:.1f} %",
        *worst,
    )


def _estimate(one: EstimateRecord) -> str:
    return f"{math.degrees(one.gap):.2f}" if one.ok else "refused"


def verdict(step: MeasuredStep) -> str:
    """Verdict on a step: it rests or it swings."""
    return "rests" if step.settled else "swings"


def summary(rows: Sequence[DemoStep]) -> tuple[str, str]:
    """One sentence on the servo, one on the estimates."""
    alone, published, twinned = (
        sum(getattr(row, n).settled for row in rows) for n in ("alone", "published", "twinned")
    )
    others = f"with the twin as published {published}, with the certified one {twinned}"
    return f"Without a twin {alone} of {len(rows)} steps settle, {others}.", _accuracy([row.estimate for row in rows])


def _accuracy(estimates: Sequence[EstimateRecord]) -> str:
    """Number of estimates, and their largest error."""
    errors = [abs(math.degrees(one.error)) for one in estimates if one.ok]
    worst = f", off by {max(errors):.2g} deg at most" if errors else ""
    return f"Estimates from {len(errors)} of {len(estimates)} windows{worst}."


def definition() -> str:
    """Definition of settled."""
    share, length = f"{100 * SETTLED:g} % of 1 mm", f"{TAIL:g} s"
    return f"A step settles, and rests, when its swing, half the peak-to-peak over the last {length}, is below {share}."


def _print_steps(rows: Sequence[DemoStep], console: Console) -> None:
    table = Table(*(head.replace(", ", "\n") for head in HEADS), box=None, pad_edge=False)
    for row in rows:
        table.add_row(*(_colored(cell) for cell in cells(row)))
    console.print(table, highlight=False)
    for sentence in summary(rows):
        console.print(sentence, highlight=False)
    console.print(definition(), style="dim", highlight=False)


def _colored(cell: str) -> str:
    for start, color in (("rests", "green"), ("swings", "red")):
        cell = cell.replace(start, f"[{color}]{start}[/]")
    return cell


def _report(comparison: Comparison, rows: Sequence[DemoStep], vector: bytes, preset: str) -> str:
    published = _accuracy([row.published_estimate for row in rows])
    return page(
        "demo.html",
        TITLE,
        summary=" ".join(summary(rows)),
        definition=definition(),
        picture=vector,
        preset=preset,
        bias=BIAS * MM,
        heads=(*HEADS, *MORE),
        steps=[(*cells(row), _estimate(row.published_estimate)) for row in rows],
        published=published.replace("Estimates", "The published twin: estimates"),
        sent_heads=_SENT,
        sent=[sent(update, comparison.servo) for update in comparison.twinned.updates],
    )
