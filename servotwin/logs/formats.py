"""File formats of logs: one entry each with its reader and its writer. A new format is one more entry here."""

from __future__ import annotations

import importlib.util
import json
import zipfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.signals import Array

_ROWS = 20_000  # of a CSV file written at a time
_METADATA = "metadata"  # name of a CSV file's last column; its first row holds the metadata as JSON


class LogColumns(NamedTuple):
    """Requested columns as the file holds them; names of all columns; metadata."""

    values: Mapping[str, Any]
    names: Sequence[str]
    metadata: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class SignalTable:
    """Columns of equal length with their units in their names, and metadata of the run."""

    columns: Mapping[str, Array]
    metadata: Mapping[str, Any]


class LogFormat(NamedTuple):
    """One format: its reader, its writer, and the library that it needs.

    Attributes
    ----------
    read : callable
        (path, requested column names) -> `LogColumns`.
    write : callable
        (table, path) -> None.
    library, extra : str
        Module that must be installed, and the extra of servotwin that installs it; empty: none.
    """

    read: Callable[[Path, Collection[str]], LogColumns]
    write: Callable[[SignalTable, Path], None]
    library: str = ""
    extra: str = ""

    def check_installed(self, file: str) -> None:
        """Raise InvalidInput where the format's library is missing; `file` is the file in words."""
        if self.library and importlib.util.find_spec(self.library) is None:
            kind = self.extra
            raise InvalidInput(
                f"{file}: {kind} needs {self.library}; give: pip install 'servotwin[{kind}]', or use .npz"
            )


def _read_csv(path: Path, requested: Collection[str]) -> LogColumns:
    """Read a line of names, then numbers.

    The metadata are JSON in the first row of a last column "metadata", so that other programs read the table as it is.
    In files of the previous version they are a first line that begins with #.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            line, skipped = file.readline(), 1
            metadata: Mapping[str, Any] = {}
            if line.startswith("#"):
                metadata, line, skipped = _parsed(line.removeprefix("#")), file.readline(), 2
            names = [name.strip() for name in line.split(",")]
            places = [names.index(name) for name in requested if name in names]
            if not places:
                header = ", ".join(filter(None, names)) or "empty"
                shown = header[:80] if header.isprintable() else "not text"
                first = next(iter(requested))
                raise InvalidInput(f"log {path}: line {skipped} must name the columns ({first}, ...); it is: {shown}")
            text = [line for line in file if not line.isspace()]
        if not metadata and text and names[-1] == _METADATA:
            quoted = text[0].partition(',"')[2].rstrip().removesuffix('"')
            metadata = _parsed(quoted.replace('""', '"'))
        values = np.loadtxt(text, delimiter=",", usecols=places, ndmin=2) if text else np.empty((0, len(places)))
    except UnicodeDecodeError as error:
        raise InvalidInput(f"log {path}: is not a text file (byte {error.start} is not UTF-8)") from None
    except InvalidInput:
        raise
    except (ValueError, IndexError) as error:
        reason = str(error).partition(";")[0].rstrip(".")
        raise InvalidInput(f"log {path}: is no table of numbers ({reason}, counted after line {skipped})") from None
    return LogColumns(dict(zip((names[i] for i in places), values.T, strict=True)), names, metadata)


def _write_csv(table: SignalTable, path: Path) -> None:
    values = np.column_stack(list(table.columns.values()))
    names, end = list(table.columns), "\n"
    if table.metadata:
        names, end = [*names, _METADATA], ",\n"
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"{','.join(names)}\n")
        if table.metadata and len(values):
            np.savetxt(file, values[:1], fmt="%.12g", delimiter=",", newline=",")
            quoted = json.dumps(table.metadata).replace('"', '""')
            file.write(f'"{quoted}"\n')
            values = values[1:]
        for first in range(0, len(values), _ROWS):
            np.savetxt(file, values[first : first + _ROWS], fmt="%.12g", delimiter=",", newline=end)


def _read_npz(path: Path, requested: Collection[str]) -> LogColumns:
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            metadata = _parsed(str(file["metadata"])) if "metadata" in file.files else {}
            return LogColumns({name: file[name] for name in file.files if name in requested}, file.files, metadata)
    except (ValueError, EOFError, zipfile.BadZipFile, AttributeError, KeyError) as error:
        raise InvalidInput(f"log {path}: is not an .npz file of numbers ({str(error).splitlines()[0]})") from None


def _write_npz(table: SignalTable, path: Path) -> None:
    arrays: dict[str, Any] = {"metadata": np.array(json.dumps(table.metadata)), **table.columns}
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _read_parquet(path: Path, requested: Collection[str]) -> LogColumns:
    import pyarrow
    from pyarrow import parquet

    try:
        schema = parquet.read_schema(path)
        table = parquet.read_table(path, columns=[name for name in requested if name in schema.names])
        columns = {name: table[name].to_numpy() for name in table.column_names}
    except pyarrow.ArrowException as error:
        raise InvalidInput(f"log {path}: is not a parquet file of numbers ({str(error).splitlines()[0]})") from None
    noted = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items() if key != b"ARROW:schema"}
    return LogColumns(columns, schema.names, {key: _number(value) for key, value in noted.items()})


def _write_parquet(table: SignalTable, path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    described = {key: value if isinstance(value, str) else json.dumps(value) for key, value in table.metadata.items()}
    parquet.write_table(pyarrow.table(dict(table.columns)).replace_schema_metadata(described), path)


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def _parsed(text: str) -> Mapping[str, Any]:
    """Parse metadata as JSON; a comment of another kind holds none."""
    try:
        metadata = json.loads(text)
    except json.JSONDecodeError:
        return {}
    return metadata if isinstance(metadata, dict) else {}


FORMATS: Mapping[str, LogFormat] = {
    ".csv": LogFormat(_read_csv, _write_csv),
    ".npz": LogFormat(_read_npz, _write_npz),
    ".parquet": LogFormat(_read_parquet, _write_parquet, library="pyarrow", extra="parquet"),
}
