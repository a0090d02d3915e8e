"""Recorded logs with unit-carrying column names: reading one as a window, writing a table of signals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servotwin.config.named_file import check_named
from servotwin.config.table import did_you_mean
from servotwin.config.units import SIGNAL_COLUMNS, suffix_of, unit_of
from servotwin.errors import InvalidInput
from servotwin.estimation.window import Window
from servotwin.logs.columns import LogColumns, Requested, SignalTable
from servotwin.logs.formats import FORMATS, WRITTEN
from servotwin.plant.signals import Array
from servotwin.runtime import files

TIME = "time_s"
_OTHER_UNITS = (
    *("nm", "um", "cm", "in", "inch", "arcsec", "arcmin", "mdeg", "mrad", "urad"),
    *("rev", "revs", "turn", "turns", "counts", "mv", "kv"),
)
"""Units in which others write logs, as the ends of columns' names."""
_PACKED, _WORKBOOK = "unpack it first; ", "export its sheet as .csv first; "
_TO_CONVERT = {
    **dict.fromkeys((".gz", ".zip", ".bz2", ".xz", ".zst", ".7z"), _PACKED),
    **dict.fromkeys((".xlsx", ".xls", ".ods"), _WORKBOOK),
}
_OTHER_TIMES = ("ms", "us", "ns", "min", "h")
_COLUMN_NAMES = (TIME, *(name for names in SIGNAL_COLUMNS.values() for name in names))


@dataclass(frozen=True, eq=False)
class Log:
    """A log as one long window in SI units, its metadata (servo, window_s ...; empty for a foreign log), and the names
    of its columns by channel."""

    whole: Window
    metadata: Mapping[str, Any]
    names: Mapping[str, str]

    def unit(self, channel: str) -> str:
        """SI unit of a channel that the log has."""
        return unit_of(self.names[channel]).si

    def table(self) -> SignalTable:
        """Columns and metadata, as `write_log` takes them."""
        whole = self.whole
        columns = {TIME: whole.time}
        columns |= {self._exact_name(channel): values for channel, values in whole.channels.items()}
        return SignalTable(columns, self.metadata)

    def _exact_name(self, channel: str) -> str:
        """Name of a column in SI units: the measured position for one that may be either."""
        names = ((name, unit_of(name)) for name in SIGNAL_COLUMNS[channel])
        return next(name for name, unit in names if unit.exact and unit.si == self.unit(channel))


def holds_signals(path: Path) -> bool:
    """True for a log that `read_log` may read: it has a position under one of servotwin's own names."""
    return not set(SIGNAL_COLUMNS["position"]).isdisjoint(read_columns(path, ()).names)


def read_log(path: Path) -> Log:
    """Read a log, complete and uniformly sampled; with motor angle and command it may lack the position.

    Raises
    ------
    InvalidInput
        The file is missing, of no known format or damaged; a column is missing, not numeric or not finite somewhere;
        the times are not uniform.
    """
    columns = read_columns(path, _COLUMN_NAMES)
    names = _chosen(path, columns)
    channels: dict[str, Any] = {key: _numbers(path, name, columns) for key, name in names.items()}
    whole = Window(**channels, time=_numbers(path, TIME, columns), source=f"log {path}")
    return Log(whole, columns.metadata, names)


def describes_its_machine(path: Path) -> bool:
    """True for a log that holds its servo, as `servotwin simulate` writes it."""
    if path.suffix.lower() not in WRITTEN:
        return False
    return isinstance(read_columns(path, ()).metadata.get("servo"), str)


def read_columns(path: Path, requested: Requested) -> LogColumns:
    """Read columns by name, or those that are chosen among all names, from a log of any known format.

    Raises
    ------
    InvalidInput
        The file is missing, of no known format or damaged.
    """
    return next(_reading(path, requested, whole=True))


def read_blocks(path: Path, requested: Requested) -> Iterator[LogColumns]:
    """Read columns by name, a part of the rows at a time where the format allows it.

    Raises
    ------
    InvalidInput
        As `read_columns`.
    """
    return _reading(path, requested, whole=False)


def _reading(path: Path, requested: Requested, whole: bool) -> Iterator[LogColumns]:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = f"the suffix {path.suffix!r} is not known: allowed are {', '.join(FORMATS)}"
        raise InvalidInput(f"log {path}: {_TO_CONVERT.get(suffix, '')}{known}")
    check_named(path, "log ")
    if not path.is_file():
        raise InvalidInput(f"log {path}: is not there; give the name of a file")
    form = FORMATS[suffix]
    form.check_installed(f"log {path}")
    try:
        if callable(requested) and not form.chooses:
            requested = requested(form.read(path, ()).names)
        if form.blocks is not None and not whole:
            yield from form.blocks(path, requested)
        else:
            yield form.read(path, requested)
    except OSError as error:
        raise InvalidInput(f"log {path}: cannot be read ({error.strerror or error})") from None


def check_output(path: Path) -> None:
    """Check a path before anything is computed for it.

    Raises
    ------
    InvalidInput
        Unknown suffix, missing directory, or a format whose library is not installed.
    """
    files.check_file(path, WRITTEN)
    FORMATS[path.suffix].check_installed(f"output {path}")


def write_log(table: SignalTable, path: Path) -> None:
    """Write a table of signals in the format that the suffix names, whole or not at all.

    Raises
    ------
    InvalidInput
        As `check_output`.
    """
    check_output(path)
    write = FORMATS[path.suffix].write
    assert write is not None  # checked above
    with files.atomic_output(path) as temporary:
        write(table, temporary)


def _chosen(path: Path, columns: LogColumns) -> dict[str, str]:
    """Names of the columns by channel."""
    every = SIGNAL_COLUMNS.items()
    chosen = {channel: next((n for n in names if n in columns.values), None) for channel, names in every}
    for channel in ("position", "theta_m", "reference"):
        if chosen[channel] is None:
            _refuse_units(path, SIGNAL_COLUMNS[channel], columns, _OTHER_UNITS)
    if TIME not in columns.values:
        _refuse_units(path, (TIME,), columns, _OTHER_TIMES)
    seen = chosen["position"] or (chosen["theta_m"] and chosen["voltage"])
    for name, place in (("position_m", seen), (TIME, TIME if TIME in columns.values else None)):
        if place is None:
            hint, known = did_you_mean(name, columns.names), ", ".join(columns.names)
            # The motor may feel its load.
            other = "" if name == TIME else ", and so are theta_m_rad and a command, which may take its place"
            raise InvalidInput(f"log {path}: column {name!r} is missing{hint}{other}; it has {known or 'none'}")
    names = {channel: name for channel, name in chosen.items() if name is not None}
    position, reference = names.get("position"), names.get("reference")
    if position is not None and reference is not None and unit_of(reference).si != unit_of(position).si:
        raise InvalidInput(
            f"log {path}: columns {position!r} and {reference!r}: must both be lengths or both be angles"
        )
    return names


def _refuse_units(path: Path, allowed: tuple[str, ...], columns: LogColumns, others: tuple[str, ...]) -> None:
    """Refuse a log whose only column of a signal is in a unit that is not read: it would seem to be missing."""
    signals = {name.removesuffix(f"_{suffix_of(name)}") for name in allowed}
    for name in columns.names:
        signal, _, unit = name.rpartition("_")
        if signal in signals and unit in others:
            given = f"one of {', '.join(allowed)}" if len(allowed) > 1 else allowed[0]
            raise InvalidInput(f"log {path}: column {name!r}: the unit {unit!r} is not read; give {given}")


def _numbers(path: Path, name: str, columns: LogColumns) -> Array:
    if name in columns.damaged:
        raise InvalidInput(f"log {path}: is no table of numbers (column {name!r}, {columns.damaged[name]})")
    try:
        if np.iscomplexobj(columns.values[name]):
            raise TypeError
        values, unit = np.asarray(columns.values[name], dtype=np.float64), unit_of(name)
        return values if unit.exact else values * unit.factor / unit.divisor
    except (TypeError, ValueError):
        raise InvalidInput(f"log {path}: column {name!r} must hold numbers") from None
