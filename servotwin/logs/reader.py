"""Recorded logs: CSV, NPZ or Parquet with unit-carrying column names, as `servotwin simulate` writes them."""

from __future__ import annotations

import importlib.util
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.estimation.window import Window
from servotwin.plant.signals import Array

COLUMNS = {
    "position": ("measured_position_m", "position_m"),
    "theta_m": ("theta_m_rad",),
    "voltage": ("voltage_v",),
    "reference": ("reference_m",),
}
"""The columns of each channel; the first one that is there counts: what was measured goes before what was."""

TIME = "time_s"
_WANTED = (TIME, *(name for names in COLUMNS.values() for name in names))


class Columns(NamedTuple):
    """The columns that are of use, the names of all, and the metadata."""

    values: Mapping[str, Any]
    names: Sequence[str]
    metadata: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Log:
    """A log as one long window, and what its writer noted: servo, window_s ...; empty for a foreign log."""

    whole: Window
    metadata: Mapping[str, Any]


def read_log(path: Path) -> Log:
    """A log, complete and uniformly sampled.

    Raises
    ------
    InvalidInput
        The file is missing, of no known kind or damaged; a column is missing, not numeric or not finite somewhere; the
        times are not uniform.
    """
    if path.suffix not in _READERS:
        allowed = ", ".join(_READERS)
        raise InvalidInput(f"log {path}: the suffix {path.suffix!r} is not known: allowed are {allowed}")
    if not path.is_file():
        raise InvalidInput(f"log {path}: is {'a directory' if path.is_dir() else 'not there'}; give the name of a file")
    try:
        columns = _READERS[path.suffix](path)
    except OSError as error:
        raise InvalidInput(f"log {path}: cannot be read ({error.strerror or error})") from None
    return Log(_whole(path, columns), columns.metadata)


def _whole(path: Path, columns: Columns) -> Window:
    found = {channel: next((n for n in names if n in columns.values), None) for channel, names in COLUMNS.items()}
    for name, place in (("position_m", found["position"]), (TIME, TIME if TIME in columns.values else None)):
        if place is None:
            hint, known = did_you_mean(name, columns.names), ", ".join(columns.names)
            raise InvalidInput(f"log {path}: column {name!r} is missing{hint}; it has {known or 'none'}")
    channels: dict[str, Any] = {key: _numbers(path, name, columns) for key, name in found.items() if name is not None}
    return Window(**channels, time=_numbers(path, TIME, columns), source=f"log {path}")


def _numbers(path: Path, name: str, columns: Columns) -> Array:
    try:
        if np.iscomplexobj(columns.values[name]):
            raise TypeError
        return np.asarray(columns.values[name], dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidInput(f"log {path}: column {name!r} must hold numbers") from None


def _read_csv(path: Path) -> Columns:
    """A first line that begins with # may hold metadata as JSON; then a line of names, then numbers."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            line, skipped = file.readline(), 1
            metadata: Mapping[str, Any] = {}
            if line.startswith("#"):
                metadata, line, skipped = _parsed(line.removeprefix("#")), file.readline(), 2
            names = [name.strip() for name in line.split(",")]
            places = [names.index(name) for name in _WANTED if name in names]
            if not places:
                found = ", ".join(filter(None, names)) or "empty"
                raise InvalidInput(
                    f"log {path}: line {skipped} must name the columns ({TIME}, ...); it is: {found:.80}"
                )
            text = file.readlines()
        values = np.loadtxt(text, delimiter=",", usecols=places, ndmin=2) if text else np.empty((0, len(places)))
    except UnicodeDecodeError as error:
        raise InvalidInput(f"log {path}: is not a text file (byte {error.start} is not UTF-8)") from None
    except InvalidInput:
        raise
    except (ValueError, IndexError) as error:
        reason = str(error).partition(";")[0].rstrip(".")
        raise InvalidInput(f"log {path}: is no table of numbers ({reason}, counted after line {skipped})") from None
    return Columns(dict(zip((names[i] for i in places), values.T, strict=True)), names, metadata)


def _read_npz(path: Path) -> Columns:
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            metadata = _parsed(str(file["metadata"])) if "metadata" in file.files else {}
            return Columns({name: file[name] for name in file.files if name in _WANTED}, file.files, metadata)
    except (ValueError, EOFError, zipfile.BadZipFile, AttributeError, KeyError) as error:
        raise InvalidInput(f"log {path}: is not an .npz file of numbers ({str(error).splitlines()[0]})") from None


def _read_parquet(path: Path) -> Columns:
    if importlib.util.find_spec("pyarrow") is None:
        raise InvalidInput(f"log {path}: parquet needs pyarrow; give: pip install 'servotwin[parquet]'")
    import pyarrow
    from pyarrow import parquet

    try:
        schema = parquet.read_schema(path)
        table = parquet.read_table(path, columns=[name for name in _WANTED if name in schema.names])
        columns = {name: table[name].to_numpy() for name in table.column_names}
    except pyarrow.ArrowException as error:
        raise InvalidInput(f"log {path}: is not a parquet file of numbers ({str(error).splitlines()[0]})") from None
    noted = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items() if key != b"ARROW:schema"}
    return Columns(columns, schema.names, {key: _number(value) for key, value in noted.items()})


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def _parsed(text: str) -> Mapping[str, Any]:
    """Metadata as JSON; a comment of another kind says nothing."""
    try:
        found = json.loads(text)
    except json.JSONDecodeError:
        return {}
    return found if isinstance(found, dict) else {}


_READERS: dict[str, Callable[[Path], Columns]] = {".csv": _read_csv, ".npz": _read_npz, ".parquet": _read_parquet}
