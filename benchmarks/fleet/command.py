"""`servotwin bench fleet`: size of the fleet that one twin on this machine can serve, with real processes."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks import report
from benchmarks.fleet import runs
from benchmarks.fleet.processes import check_system
from benchmarks.fleet.setting import TABLE, FleetScale, build_table, write_file
from benchmarks.fleet.stock import WindowSource, stock
from benchmarks.fleet.tables import document, show
from benchmarks.fleet.watch import ResourceSample

SCHEMA = "servotwin-bench-fleet/1"
NAME = "fleet"


def fleet(
    date: str = "", output: Path | None = None, scale: FleetScale | None = None, console: Console | None = None
) -> tuple[runs.FleetRun, runs.FleetRun]:
    """Measure ingest alone, then a fleet at its cadence with an outage; show, and write JSON if `output` is given.

    Everything lies in a folder of its own in the system's temporary one, which is removed at the end, as are all
    processes: 20 kB for every window.

    Parameters
    ----------
    date : str
        Written into the JSON.
    output : Path, optional
        File to write, suffix .json.
    scale : FleetScale, optional
    console : Console, optional

    Raises
    ------
    InvalidInput
        An output that cannot be written, or a system without /proc.
    RuntimeError
        The twin or the edges failed: that is no measurement.
    """
    console, scale = console or Console(), scale or FleetScale()
    check_system()
    report.check(output)
    with _folder() as folder, _progress(console) as progress:
        places = _prepared(folder, scale, progress)
        alone = _ingest(folder, scale, places, progress)
        whole = _fleet(folder, scale, places, progress)
    show(scale, alone, whole, console)
    report.write(output, report.text(SCHEMA, date, scale=asdict(scale), **document(scale, alone, whole)), console)
    return alone, whole


def _prepared(folder: Path, scale: FleetScale, progress: Progress) -> list[WindowSource]:
    """Make the stock of windows and the table of certificates."""
    bar = progress.add_task("verifying settings", total=None)
    build_table(folder, scale)
    progress.update(bar, description="simulating windows")
    places = stock(write_file(folder, scale).models[0], scale.places, scale.windows)
    progress.remove_task(bar)
    return places


def _ingest(folder: Path, scale: FleetScale, places: list[WindowSource], progress: Progress) -> runs.FleetRun:
    apart = folder / "ingest"
    apart.mkdir()
    shutil.copy(folder / TABLE, apart / TABLE)
    bar = progress.add_task("ingest alone", total=scale.ingest)
    run = runs.ingest(apart, scale, places, lambda sample: progress.update(bar, completed=sample.time))
    progress.remove_task(bar)
    shutil.rmtree(apart)
    return run


def _fleet(folder: Path, scale: FleetScale, places: list[WindowSource], progress: Progress) -> runs.FleetRun:
    bar = progress.add_task("introducing servos", total=scale.steady + scale.outage + scale.after)

    def tell(sample: ResourceSample) -> None:
        phase = _phase(scale, sample.time)
        progress.update(bar, completed=sample.time, description=f"{phase}: {sample.waiting} windows wait")

    run = runs.fleet(folder, scale, places, tell)
    progress.remove_task(bar)
    return run


def _phase(scale: FleetScale, time: float) -> str:
    ends = {"at cadence": scale.steady, "outage": scale.outage, "after the outage": scale.after}
    passed = 0.0
    for name, length in ends.items():
        passed += length
        if time < passed:
            return name
    return "working off"


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="servotwin-fleet-") as name:
        yield Path(name)


@contextmanager
def _progress(console: Console) -> Iterator[Progress]:
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console, transient=True
    ) as progress:
        yield progress
