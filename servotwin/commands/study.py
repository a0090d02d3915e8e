"""Commands that simulate, estimate and measure, each on what it is given."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option(help="Where the report goes.")] = Path("servotwin-demo"),
    preset: Annotated[str, typer.Option(help="paper, table1 or paper-gain2.")] = "paper",
) -> None:
    """A servo wears out twice: once alone, once watched over by its twin."""
    from servotwin.demo import demo as run

    run(out, preset)


def reproduce(
    only: Annotated[list[str] | None, typer.Option(help="Only these figures and claims: fig12, crossover ...")] = None,
    out: Annotated[Path, typer.Option(help="Where figures, claims.json and report.html go.")] = Path("reproduction"),
    preset: Annotated[str, typer.Option(help="The preset of the figures; claims are measured in all three.")] = "paper",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; one per core by default.")] = None,
) -> None:
    """Every figure and claim of the paper beside what we measure."""
    from servotwin.reproduce.everything import reproduce as run

    run(out, only=tuple(only or ()), preset=preset, workers=workers)


def simulate(
    scenario: Annotated[Path, typer.Argument(help="A scenario's TOML.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="run.parquet, run.npz or run.csv.")],
) -> None:
    """Run one scenario and write its signals."""
    from servotwin.record import record

    record(scenario, output)


def convert(
    log: Annotated[Path, typer.Argument(help="A .csv, .npz or .parquet with time_s, position_m, theta_m_rad ...")],
    output: Annotated[Path, typer.Argument(help="run.csv, which an edge can replay, run.npz or run.parquet.")],
) -> None:
    """A recorded log in another format."""
    from servotwin.record import convert as run

    run(log, output)


def identify(
    log: Annotated[Path, typer.Argument(help="A .csv, .npz or .parquet with time_s, position_m, theta_m_rad ...")],
    servo: Annotated[
        str | None, typer.Option(help="A preset's name or a servo's TOML; the log's own by default.")
    ] = None,
    start: Annotated[float | None, typer.Option(help="One window from here on, s; not one per step.")] = None,
    duration: Annotated[
        float | None, typer.Option(help="Length of that window, s; to the log's end by default.")
    ] = None,
    window: Annotated[
        float | None, typer.Option(help="Length of the windows at the steps, s; the log's, or 1.")
    ] = None,
    pre_trigger: Annotated[float | None, typer.Option(help="How much of it lies before the step, s.")] = None,
    method: Annotated[str, typer.Option(help="whitened or paper.")] = "whitened",
    wear_deg: Annotated[float | None, typer.Option(help="The gap grows by about so much ...")] = None,
    wear_over_s: Annotated[float | None, typer.Option(help="... in so long; 0.2 deg/s by default.")] = None,
    gap_limit_deg: Annotated[float | None, typer.Option(help="Tell how long until the gap is that large.")] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")] = False,
) -> None:
    """The gap and its trend from a recorded log."""
    from servotwin.identification import Request, tell

    cut = (start, duration, window, pre_trigger)
    tell(Request(log, servo, *cut, method, wear_deg, wear_over_s, gap_limit_deg), json)


def bench(
    workloads: Annotated[
        list[str] | None,
        typer.Argument(
            help="W1, W2, W3, sampled, decision, start (all by default); or one of estimator, hostile, policies, tick, "
            "novelty, fleet."
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write every run into this .json file.")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Rounds; 7 by default.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small workloads, to see that all works.")] = False,
    full: Annotated[bool, typer.Option("--full", help="fleet: five minutes, and an outage of ten.")] = False,
    slow: Annotated[bool, typer.Option("--slow", help="Also what takes many seconds a run: scipy, compiling.")] = False,
    reference: Annotated[Path | None, typer.Option(help="An .npz with W1's true q3, to compare with.")] = None,
) -> None:
    """Speed and accuracy beside what one would use instead, side by side."""
    from datetime import UTC, datetime

    from servotwin.bench.alone import run_alone

    date = datetime.now(UTC).isoformat(timespec="seconds")
    others = slow or runs is not None or reference is not None
    if run_alone(tuple(workloads or ()), date, json, quick, others, full):
        return
    from servotwin.bench.catalogue import Options
    from servotwin.bench.command import bench as run

    run(tuple(workloads or ()), date, json, runs, Options(quick, slow, reference))
