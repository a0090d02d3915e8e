"""File of a table of verified settings, with the model and demands that it holds for."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from pathlib import Path
from time import perf_counter

import msgspec
from msgspec import Struct

import servotwin
from servotwin.config.named_file import check_named
from servotwin.errors import InvalidInput
from servotwin.plant.display_units import command_unit, position_unit
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.fallback import flattened
from servotwin.redesign.certified.lookup import CellIndex, CertifiedTable, Grid, cells_of, certify_cell, table_of
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.design import decoded_part
from servotwin.runtime import files

SUFFIX = ".table"
LARGEST = 64 * 1024 * 1024
"""Largest file that is read, bytes."""
_SAVED_EVERY = 10.0  # s between two writes of an unfinished table


class TableFile(Struct, frozen=True, tag="certified-table/1"):
    """Content of the file.

    Attributes
    ----------
    of : dict of str to str
        Everything that the verification depends on, in full.
    grid : Grid
    fallback : Certificate
    cells : tuple of (CellIndex, Certificate or None)
        Fewer than the grid has while it is unfinished.
    """

    of: dict[str, str]
    grid: Grid
    fallback: Certificate
    cells: tuple[tuple[CellIndex, Certificate | None], ...]


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(TableFile, dec_hook=decoded_part)


def load(path: Path, policy: CertifiedPolicy) -> CertifiedTable:
    """Read a finished table that was verified for a policy.

    Raises
    ------
    InvalidInput
        The file cannot be read, belongs to another model, other demands or another version, or is unfinished.
    """
    file = _read(path)
    _check_owner(path, file, policy)
    missing = len(set(cells_of(file.grid, policy.uncertainty.gap)) - {key for key, _ in file.cells})
    if missing:
        raise InvalidInput(f"{path}: {missing} cells of this table are not verified yet: run the same command again")
    return table_of(policy, file.grid, dict(file.cells))


def build(
    path: Path, policy: CertifiedPolicy, grid: Grid, clock: Callable[[], float] = perf_counter
) -> Generator[tuple[int, int], None, None]:
    """Verify a table cell by cell into a file, continuing an earlier run; yield (cells done, cells in all).

    Finished cells are written every few seconds and when the generator is closed.

    Raises
    ------
    InvalidInput
        The file exists and is no table, or one for another policy or grid; it cannot be written; there is no fallback
        set.
    """
    keys = list(cells_of(grid, policy.uncertainty.gap))
    cells = _finished_cells(path, policy, grid)
    saved, fallback = clock(), policy.fallback()
    try:
        for key in keys:
            if key not in cells:
                cells[key] = certify_cell(policy, grid, key)
            yield len(cells), len(keys)
            if clock() - saved > _SAVED_EVERY:
                _write(path, TableFile(dependencies(policy), grid, fallback, tuple(cells.items())))
                saved = clock()
    finally:
        _write(path, TableFile(dependencies(policy), grid, fallback, tuple(cells.items())))


def dependencies(policy: CertifiedPolicy) -> dict[str, str]:
    """Everything that a policy's certificates depend on, by name and in full."""
    parts = {"servotwin": servotwin.__version__, "feedforward_limit": repr(policy.feedforward_limit)}
    for name in ("servo", "uncertainty", "demands"):
        parts |= dict(flattened(name, getattr(policy, name)))
    trial = {f"trial.{name}": repr(getattr(policy.simulations, name)) for name in ("duration", "last", "rate")}
    return {**parts, **trial}


def _finished_cells(path: Path, policy: CertifiedPolicy, grid: Grid) -> dict[CellIndex, Certificate | None]:
    """Cells that an earlier run has verified; none without a file."""
    if not path.exists():
        return {}
    file = _read(path)
    _check_owner(path, file, policy)
    if file.grid != grid:
        raise InvalidInput(
            f"{path}: is a table on another grid ({_in_words(file.grid, policy)}); choose another file, or remove it"
        )
    return dict(file.cells)


def _in_words(grid: Grid, policy: CertifiedPolicy) -> str:
    """A grid's cells, biases and noises with their units."""
    biases, noises = (", ".join(f"{each:g}" for each in values) for values in (grid.biases, grid.noises))
    return (
        f"cells from {math.degrees(grid.finest):.4g} deg on, biases of {biases} {command_unit(policy.servo)}, "
        f"noises of {noises} {position_unit(policy.servo).si}"
    )


def _read(path: Path) -> TableFile:
    check_named(path)
    try:
        if path.stat().st_size > LARGEST:
            raise InvalidInput(f"{path}: is larger than {LARGEST} bytes, which no table is")
        return _decoder.decode(path.read_bytes())
    except OSError as error:
        raise InvalidInput(
            f"{path}: cannot be read ({error.strerror or error}); `servotwin certify` makes tables"
        ) from None
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidInput(f"{path}: is no table of verified settings ({error})") from None


def _check_owner(path: Path, file: TableFile, policy: CertifiedPolicy) -> None:
    """Refuse a table whose certificates depend on other values than this policy's."""
    ours = dependencies(policy)
    differing = [key for key in sorted({*ours, *file.of}) if ours.get(key) != file.of.get(key)]
    if differing:
        key = differing[0]
        there, here = (each.get(key, "nothing") for each in (file.of, ours))
        more = f" and {len(differing) - 1} more" if len(differing) > 1 else ""
        raise InvalidInput(
            f"{path}: was verified for {key} = {there}, and this is {here}{more}: certify a table of its own with"
            " `servotwin certify`"
        )


def _write(path: Path, table: TableFile) -> None:
    with files.atomic_output(path) as temporary:
        temporary.write_bytes(_encoder.encode(table))
