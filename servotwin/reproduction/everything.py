"""`servotwin reproduce`: every figure, every claim, claims.json and the report."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.plant.servo import PRESETS
from servotwin.reproduction import chapter, claims, document, figures
from servotwin.reproduction.claims import Claim, Result, Verdict
from servotwin.reproduction.report import report
from servotwin.reproduction.tasks import ClaimsTask, Drawn, FigureTask, Task, perform
from servotwin.runtime import files

Outcome = Drawn | tuple[Result, ...]


@dataclass(frozen=True)
class Selection:
    """What to reproduce."""

    figures: tuple[str, ...]
    claims: tuple[Claim, ...]


def reproduce(
    out: Path,
    only: Sequence[str] = (),
    preset: str = "paper",
    workers: int | None = None,
    console: Console | None = None,
) -> Path:
    """Reproduce the paper, or what `only` names, into the directory `out`.

    Parameters
    ----------
    out : Path
        Made if missing. Gets NAME.svg and NAME.png for each figure, claims.json (see `document`), report.html, and
        where policies are compared beyond.json (see `chapter`).
    only : sequence of str
        Names of figures and claims; empty: all.
    preset : str
        Of the figures; claims are measured in every preset.
    workers : int, optional
        Processes; None: one per core, or none for a small selection.
    console : Console, optional
        Where progress and the verdicts are shown.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    InvalidInput
        A name that is neither a figure nor a claim, an unknown preset, a directory that cannot be written.
    """
    console = console or Console()
    selection = select(only)
    if preset not in PRESETS:
        hint = did_you_mean(preset, PRESETS)
        raise InvalidInput(f"preset {preset!r} does not exist{hint}; give one of {', '.join(PRESETS)}")
    tasks = planned(selection, preset, files.make_directory(out))
    drawn, results = _sorted(_watched(tasks, workers or _workers(tasks), console), selection)
    files.write_text(out / "claims.json", document.dumps(results))
    compared = {one.name: one.outcomes for one in drawn if one.outcomes}
    if compared:
        files.write_text(out / "beyond.json", chapter.dumps(compared, preset))
    path = files.write_text(out / "report.html", report(results, drawn, preset))
    _tell(results, path, console)
    return path


def select(only: Sequence[str]) -> Selection:
    """Figures and claims by name; several names may stand in one text, with commas."""
    names = {one.name: one for one in figures.PLATES}
    listed = {claim.id: claim for claim in claims.claims()}
    wanted = [name.strip() for text in only for name in text.split(",") if name.strip()]
    for name in wanted:
        if name not in names and name not in listed:
            hint = did_you_mean(name, (*names, *listed))
            raise InvalidInput(
                f"--only {name!r}: is neither a figure nor a claim{hint}; figures are {', '.join(names)}, claims are"
                " named as in claims.json"
            )
    if not wanted:
        return Selection(tuple(names), tuple(listed.values()))
    return Selection(
        tuple(name for name in names if name in wanted), tuple(c for name, c in listed.items() if name in wanted)
    )


def planned(selection: Selection, preset: str, directory: Path) -> list[Task[Outcome]]:
    """Independent tasks, preset by preset and that of the figures last, so that neighbours can share runs."""
    groups = [tuple(group) for _, group in groupby(sorted(selection.claims, key=claims.group), key=claims.group)]
    presets = sorted(PRESETS, key=lambda each: each == preset)
    measuring = [ClaimsTask(each, group) for each in presets for group in reversed(groups)]
    return [*measuring, *(FigureTask(preset, name, directory) for name in reversed(selection.figures))]


def _workers(tasks: Sequence[Task[Outcome]]) -> int:
    """One process per core; starting them does not pay for a handful of figures."""
    heavy = any(isinstance(task, ClaimsTask) for task in tasks) or len(tasks) > 4
    return (os.cpu_count() or 1) if heavy else 1


def _watched(tasks: Sequence[Task[Outcome]], workers: int, console: Console) -> list[Outcome]:
    """All outcomes, under a progress bar."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    found = []
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("reproducing", total=len(tasks))
        for outcome in perform(tasks, workers):
            found.append(outcome)
            progress.advance(bar)
    return found


def _sorted(outcomes: Iterable[Outcome], selection: Selection) -> tuple[list[Drawn], list[Result]]:
    """Figures and results in the paper's order, figures of ours last."""
    outcomes = list(outcomes)
    by_name = {one.name: one for one in outcomes if isinstance(one, Drawn)}
    by_key = {(r.claim.id, r.preset): r for found in outcomes if isinstance(found, tuple) for r in found}
    drawn = [by_name[name] for name in selection.figures]
    return drawn, [by_key[claim.id, preset] for claim in selection.claims for preset in PRESETS]


_COLORS = {Verdict.REPRODUCED: "green", Verdict.NOT_AS_STATED: "red", Verdict.CANNOT_BE_CHECKED: "dim"}


def _tell(results: Sequence[Result], path: Path, console: Console) -> None:
    """The verdicts as a table, and where the report is."""
    if results:
        table = Table("claim", *PRESETS, box=None, pad_edge=False)
        for claim, row in document.by_claim(results).items():
            table.add_row(claim.id, *(_verdict(result.finding.verdict) for result in row.values()))
        console.print(table)
    console.print(f"report: {path}", soft_wrap=True, highlight=False)


def _verdict(verdict: Verdict) -> str:
    return f"[{_COLORS[verdict]}]{verdict.value}[/]"
