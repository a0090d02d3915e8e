"""The command line of the benchmarks: `python -m benchmarks`, or `servotwin bench` in a source checkout."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def bench(
    workloads: Annotated[
        list[str] | None,
        typer.Argument(
            help="W1, two-mass, W2, W3, sampled, decision, start (all by default); or one of estimator, windows, "
            "hostile, policies, loops, certificates, compensation, friction, tick, novelty, triage, fleet, overload, "
            "endurance."
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write every run into this .json file.")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Rounds; 7 by default.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small workloads, as a check.")] = False,
    full: Annotated[
        bool, typer.Option("--full", help="fleet: five minutes, and an outage of ten; overload: ten minutes.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of the machines (windows, loops, certificates) or faults (endurance)."),
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.1, help="endurance: length; 10 by default.")] = None,
    servos: Annotated[
        int | None,
        typer.Option(min=4, help="Servos. endurance: 4 by default, which have edges, the others none; fleet: 10 000."),
    ] = None,
    slow: Annotated[bool, typer.Option("--slow", help="Add jobs of many seconds: scipy, compilation.")] = False,
    reference: Annotated[Path | None, typer.Option(help="An .npz with W1's true q3, to compare with.")] = None,
) -> None:
    """Measure speed and accuracy beside other solvers."""
    # A benchmark that is told to end must end the processes that it has started, as after Ctrl-C.
    former = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from datetime import UTC, datetime

        from benchmarks.alone import run_alone

        date = datetime.now(UTC).isoformat(timespec="seconds")
        others = slow or runs is not None or reference is not None
        if run_alone(tuple(workloads or ()), date, json, quick, others, full, seed, minutes, servos):
            return
        from benchmarks.catalogue import Options
        from benchmarks.command import bench as run

        run(tuple(workloads or ()), date, json, runs, Options(quick, slow, reference))
    finally:
        signal.signal(signal.SIGTERM, former)
