"""`servotwin certify`: verify settings beforehand, cell by cell, for twins that look them up."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from time import monotonic
from typing import TypeAlias

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from servotwin.cli.gap_options import stated_gap
from servotwin.cli.own_options import option_of, own_option
from servotwin.config.table import Table, did_you_mean, read_toml
from servotwin.config.toml import attribute
from servotwin.config.units import unit_of
from servotwin.cosim.scenario import Scenario
from servotwin.errors import InvalidInput
from servotwin.plant.own_units import own_units
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.lookup import CertifiedTable, Grid
from servotwin.redesign.certified.lookup_file import SUFFIX, build, load
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.registry import certified_policy, check_tabled
from servotwin.twin.model_registry import models_of
from servotwin.twin.settings import TwinSettings

_Values: TypeAlias = tuple[float, ...] | None
_LINE_EVERY = 30.0  # s between two lines where no bar can be shown


@dataclass(frozen=True)
class _TableJob:
    """A table to verify: name of its model, policy and file."""

    name: str
    policy: CertifiedPolicy
    path: Path


def certify(
    file: Path,
    model: str | None = None,
    out: Path | None = None,
    grid: Grid | GridOptions | None = None,
    console: Console | None = None,
) -> tuple[CertifiedTable, ...]:
    """Verify the tables that a twin's file or a scenario names, or continue an interrupted verification.

    Parameters
    ----------
    file : Path
    model : str, optional
        Only this model of a twin's file; None: all that have a key `table`.
    out : Path, optional
        File of the table of one model; None: the one that `table` names.
    grid : Grid or GridOptions, optional
        For all models; `Grid.of` each by default.
    console : Console, optional
        Where progress and summary are shown; progress as lines where it is no terminal.

    Raises
    ------
    InvalidInput
        There is nothing to verify, a file belongs to another model or grid or cannot be written, or there is no
        fallback set.
    KeyboardInterrupt
        Its message says how many cells are finished and how to continue.
    """
    console = console or Console()
    given = grid or GridOptions()
    chosen = _chosen(file, model, out)
    # All that is wrong with the command is said before the search, which may take minutes.
    for name, (servo, settings) in chosen.items():
        _check(name, servo, settings, out)
        if isinstance(given, GridOptions):
            given.values(name, servo)
    with _progress(console, TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()) as progress:
        text = "looking for a verified fallback set"
        progress.add_task(text, total=None)
        if not console.is_terminal:
            console.print(text)
        jobs = [_table_job(name, servo, settings, out) for name, (servo, settings) in chosen.items()]
        pairs = [(job, given if isinstance(given, Grid) else given.grid(job.name, job.policy)) for job in jobs]
    return tuple(_verify(job, grid, console) for job, grid in pairs)


def _progress(console: Console, *columns: ProgressColumn) -> Progress:
    """Bars that disappear in the end; none where the console is no terminal."""
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@dataclass(frozen=True)
class GridOptions:
    """Options of the command that make the grid; those that are left out have their default.

    Attributes
    ----------
    finest_deg : float, optional
        At the motor.
    biases, noises : mapping
        VALUE,VALUE,... by key, such as `bias_mv` or `noise_mdeg`: in the units of the model's command and position.
    finest_at_load : mapping
        In place of `finest_deg`, by key: `finest_at_load_um`.
    """

    finest_deg: float | None = None
    biases: Mapping[str, str | None] = field(default_factory=dict)
    noises: Mapping[str, str | None] = field(default_factory=dict)
    finest_at_load: Mapping[str, float] = field(default_factory=dict)

    def grid(self, name: str, policy: CertifiedPolicy) -> Grid:
        """The grid of a model of that name.

        Raises
        ------
        InvalidInput
            A value is outside its range, or in a unit that the model does not have.
        """
        return Grid.of(policy, *self.values(name, policy.servo))

    def values(self, name: str, servo: Plant) -> tuple[float | None, _Values, _Values]:
        """Finest gap (rad at the motor), biases and noises (SI) for a servo, None where not given; raises as `grid`."""
        machine = f"model {name!r}"
        form, finest = stated_gap("finest", self.finest_deg, self.finest_at_load, machine, servo)
        if finest is not None and not 0.0 < finest < math.inf:
            raise InvalidInput(f"{form.option} {finest:g} {form.unit}: must be finite and above 0")
        units = own_units(servo)
        return (
            None if finest is None else form.at_motor(finest),
            _rising(units.key("bias_mv"), own_option(self.biases, "bias_mv", machine, units), above=True),
            _rising(units.key("noise_um"), own_option(self.noises, "noise_um", machine, units), above=False),
        )


def _rising(key: str, text: str | None, above: bool) -> _Values:
    """Values of an option, in SI; None: not given."""
    if text is None:
        return None
    try:
        values = tuple(map(float, text.split(",")))
    except ValueError:
        values = ()
    rising = all(low < high for low, high in pairwise(values))
    if not values or not rising or not (values[0] > 0.0 or (values[0] == 0.0 and not above)) or math.inf in values:
        allowed = "above 0" if above else "0 or more"
        raise InvalidInput(f"{option_of(key)} {text!r}: give VALUE,VALUE,... in {unit_of(key).name}, rising, {allowed}")
    return tuple(map(unit_of(key).to_si, values))


def _chosen(file: Path, model: str | None, out: Path | None) -> dict[str, tuple[Plant, TwinSettings]]:
    """Models of a file whose tables are to be verified, by name."""
    table = read_toml(file)
    known = _models(table, file)
    if model is not None and model not in known:
        raise InvalidInput(f"--model {model!r}: {file} has no such model{did_you_mean(model, known)}")
    chosen = {name: pair for name, pair in known.items() if name == (model or name)}
    if out is None:
        chosen = {name: pair for name, pair in chosen.items() if pair[1].table is not None}
    if not chosen:
        raise InvalidInput(f'{file}: no model has a key table = "NAME{SUFFIX}" in [twin]: give it, or --out')
    if out is not None and len(chosen) > 1:
        raise InvalidInput(f"--out {out}: {file} has {len(chosen)} models; choose one with --model")
    return chosen


def _models(table: Table, file: Path) -> dict[str, tuple[Plant, TwinSettings]]:
    """Model and settings by name: of a twin's file, or of a scenario, whose table need not be there yet."""
    if "models" in table.values:
        models = models_of(table, file.parent, checked=False)
        return {model.name: (model.servo, model.settings) for model in models}
    twin = table.table("twin")
    path = attribute(twin, TwinSettings, "table", file.parent)
    values = {key: value for key, value in twin.values.items() if key != "table"}
    scenario = Scenario.from_table(Table(table.source, {**table.values, "twin": values}), file.parent)
    return {scenario.name: (scenario.model, scenario.twin.replace(table=path))}


def _check(name: str, servo: Plant, settings: TwinSettings, out: Path | None) -> None:
    if settings.policy != "certified":
        raise InvalidInput(f"model {name!r}: policy {settings.policy!r} verifies nothing; only 'certified' does")
    check_tabled(servo, f"{_path(settings, out)}: model {name!r}")


def _path(settings: TwinSettings, out: Path | None) -> Path:
    return out or Path(settings.table or "")


def _table_job(name: str, servo: Plant, settings: TwinSettings, out: Path | None) -> _TableJob:
    return _TableJob(name, certified_policy(servo, settings), _path(settings, out))


def _verify(job: _TableJob, grid: Grid, console: Console) -> CertifiedTable:
    """Verify one table, under a progress bar."""
    done, total, line = 0, 0, monotonic()
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    try:
        with (
            _progress(console, TextColumn("{task.description}"), *columns) as progress,
            closing(build(job.path, job.policy, grid)) as steps,
        ):
            bar = progress.add_task(f"verifying {job.name}", total=None)
            for done, total in steps:
                progress.update(bar, completed=done, total=total)
                if not console.is_terminal and monotonic() - line >= _LINE_EVERY:
                    console.print(f"verifying {job.name}: {done} of {total} cells", highlight=False)
                    line = monotonic()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted: {done} of {total} cells are in {job.path}; the same command goes on from there"
        ) from None
    table = load(job.path, job.policy)
    console.print(_summary(job, table), soft_wrap=True, highlight=False)
    return table


def _summary(job: _TableJob, table: CertifiedTable) -> str:
    shares = Counter(cell is not None for cell in table.cells.values())
    different = {cell.setting for cell in table.cells.values() if cell is not None}
    low, high = (math.degrees(gap) for gap in table.stated)
    others = "; in the others the twin sends the fallback set" if shares[False] else ""
    return (
        f"written: {job.path}: {shares[True]} of {len(table.cells)} cells of gaps from {low:g} to {high:g} deg are"
        f" verified, with {len(different)} different setting{'s' * (len(different) != 1)}{others}\n"
        f"fallback set, for all of them: {table.fallback.tried(job.policy.servo)}"
    )
