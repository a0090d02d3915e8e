"""`servotwin reproduce`: every figure, every claim, claims.json and the report."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.plant.servo import PRESETS
from servotwin.report import style
from servotwin.reproduction import claims, documents, figures
from servotwin.reproduction.claims import Claim, ClaimResult, Verdict
from servotwin.reproduction.figures import DrawnFigure, FigureSpec
from servotwin.reproduction.report import report
from servotwin.reproduction.runs import Runs
from servotwin.runtime import files
from servotwin.runtime.interrupts import ignore_interrupts, interrupts_blocked

_R = TypeVar("_R", covariant=True)
TaskResult = DrawnFigure | tuple[ClaimResult, ...]


@dataclass(frozen=True)
class Selection:
    """Figures (by name) and claims to reproduce."""

    figures: tuple[str, ...]
    claims: tuple[Claim, ...]


class ReproductionTask(Protocol[_R]):
    """A picklable piece of work."""

    def run(self) -> _R: ...


@lru_cache(maxsize=1)
def _runs_of(preset: str) -> Runs:
    """Return this process's runs of a preset; successive tasks of one preset share them."""
    return Runs(preset)


@dataclass(frozen=True)
class ClaimsTask:
    """Measure some claims in one preset."""

    preset: str
    claims: tuple[Claim, ...]

    def run(self) -> tuple[ClaimResult, ...]:
        """Measure the claims."""
        return tuple(claims.measure(claim, _runs_of(self.preset)) for claim in self.claims)


@dataclass(frozen=True)
class FigureTask:
    """Draw one figure for one preset and write its files."""

    preset: str
    name: str
    directory: Path

    def run(self) -> DrawnFigure:
        """Draw; the vector image is also in NAME.svg, beside NAME.png."""
        runs, spec = _runs_of(self.preset), figure_spec(self.name)
        path = style.save(spec.draw(runs), self.directory, self.name)
        outcomes = tuple(replace(one, run=None) for one in spec.measure(runs))
        return DrawnFigure(self.name, spec.title, spec.caption, path.read_bytes(), outcomes)


def figure_spec(name: str) -> FigureSpec[object]:
    """Look up a figure by its name."""
    return next(one for one in figures.FIGURES if one.name == name)


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
        Made if missing. Gets NAME.svg and NAME.png for each figure, claims.json (see `documents`), report.html, and
        beyond.json where policies are compared.
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
    drawn, results = _sorted(_with_progress(tasks, workers or _workers(tasks), console), selection)
    files.write_text(out / "claims.json", documents.claims_json(results))
    compared = {one.name: one.outcomes for one in drawn if one.outcomes}
    if compared:
        files.write_text(out / "beyond.json", documents.beyond_json(compared, preset))
    path = files.write_text(out / "report.html", report(results, drawn, preset))
    _print_verdicts(results, path, console)
    return path


def select(only: Sequence[str]) -> Selection:
    """Select figures and claims by name; a text may hold several names, separated by commas."""
    names = {one.name: one for one in figures.FIGURES}
    listed = {claim.id: claim for claim in claims.claims()}
    requested = [name.strip() for text in only for name in text.split(",") if name.strip()]
    for name in requested:
        if name not in names and name not in listed:
            hint = did_you_mean(name, (*names, *listed))
            raise InvalidInput(
                f"--only {name!r}: is neither a figure nor a claim{hint}; figures are {', '.join(names)}, claims are"
                " named as in claims.json"
            )
    if not requested:
        return Selection(tuple(names), tuple(listed.values()))
    return Selection(
        tuple(name for name in names if name in requested), tuple(c for name, c in listed.items() if name in requested)
    )


def planned(selection: Selection, preset: str, directory: Path) -> list[ReproductionTask[TaskResult]]:
    """Plan independent tasks preset by preset, the figures' preset last, so that neighbours can share runs."""
    groups = [tuple(group) for _, group in groupby(sorted(selection.claims, key=claims.group), key=claims.group)]
    presets = sorted(PRESETS, key=lambda each: each == preset)
    measuring = [ClaimsTask(each, group) for each in presets for group in reversed(groups)]
    return [*measuring, *(FigureTask(preset, name, directory) for name in reversed(selection.figures))]


def _workers(tasks: Sequence[ReproductionTask[TaskResult]]) -> int:
    """Number of processes: one per core, or one in all for a handful of figures."""
    heavy = any(isinstance(task, ClaimsTask) for task in tasks) or len(tasks) > 4
    return (os.cpu_count() or 1) if heavy else 1


def _with_progress(tasks: Sequence[ReproductionTask[TaskResult]], workers: int, console: Console) -> list[TaskResult]:
    """Perform all tasks under a progress bar."""
    results = []
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), console=console
    ) as progress:
        bar = progress.add_task("reproducing", total=len(tasks))
        for result in _perform(tasks, workers):
            results.append(result)
            progress.advance(bar)
    return results


def _sorted(outcomes: Iterable[TaskResult], selection: Selection) -> tuple[list[DrawnFigure], list[ClaimResult]]:
    """Sort figures and results into the paper's order; figures beyond the paper come last."""
    outcomes = list(outcomes)
    by_name = {one.name: one for one in outcomes if isinstance(one, DrawnFigure)}
    by_key = {(r.claim.id, r.preset): r for results in outcomes if isinstance(results, tuple) for r in results}
    drawn = [by_name[name] for name in selection.figures]
    return drawn, [by_key[claim.id, preset] for claim in selection.claims for preset in PRESETS]


def _perform(tasks: Sequence[ReproductionTask[_R]], workers: int) -> Iterator[_R]:
    """Yield results in order of completion; with one worker, in this process.

    An interrupt ends the workers: unfinished tasks are lost, and no file is left half written.
    """
    if workers == 1 or len(tasks) < 2:
        yield from (task.run() for task in tasks)
        return
    with interrupts_blocked():
        pool = multiprocessing.get_context("spawn").Pool(min(workers, len(tasks)), ignore_interrupts)
    with pool:
        yield from pool.imap_unordered(_run, tasks)


def _run(task: ReproductionTask[_R]) -> _R:
    return task.run()


_COLORS = {Verdict.REPRODUCED: "green", Verdict.NOT_AS_STATED: "red", Verdict.CANNOT_BE_CHECKED: "dim"}


def _print_verdicts(results: Sequence[ClaimResult], path: Path, console: Console) -> None:
    """Print the verdicts as a table, and the path of the report."""
    if results:
        table = Table("claim", *PRESETS, box=None, pad_edge=False)
        for claim, row in documents.results_by_claim(results).items():
            table.add_row(claim.id, *(_verdict(result.finding.verdict) for result in row.values()))
        console.print(table)
    console.print(f"report: {path}", soft_wrap=True, highlight=False)


def _verdict(verdict: Verdict) -> str:
    return f"[{_COLORS[verdict]}]{verdict.value}[/]"
