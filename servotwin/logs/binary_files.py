"""NumPy and Parquet files."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import ColumnPlace, LogColumns, SignalTable, parsed, places_of

_ROWS = 500_000  # read at a time
_DAMAGED = (ValueError, EOFError, zipfile.BadZipFile, AttributeError, KeyError)  # of files that are not NumPy's


def read_npz(path: Path, requested: Collection[str]) -> LogColumns:
    """Read arrays by name; matrices and records as `places_of` calls their columns."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            metadata = parsed(str(file["metadata"])) if "metadata" in file.files else {}
            places: dict[str, ColumnPlace] = {}
            for name in file.files:
                with file.zip.open(f"{name}.npy") as member:
                    places |= places_of(name, *_head(member))
            wanted = {name: place for name, place in places.items() if name in requested}
            arrays = {name: file[name] for name in {place.array for place in wanted.values()}}
            return LogColumns(
                {name: place.of(arrays[place.array]) for name, place in wanted.items()}, tuple(places), metadata
            )
    except _DAMAGED as error:
        raise InvalidInput(f"log {path}: is not an .npz file of numbers{_why(error)}") from None


def _head(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an array in a .npy file."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return shape, dtype


def read_npy(path: Path, requested: Collection[str]) -> LogColumns:
    """Read the columns of one array: records by name, those of a matrix as col1, col2 and so on."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except _DAMAGED as error:
        raise InvalidInput(f"log {path}: is not an .npy file of numbers{_why(error)}") from None
    places = places_of("", array.shape, array.dtype)
    if not array.dtype.names:
        places = {f"col{i}": place for i, place in enumerate(places.values(), 1)}
    return LogColumns({name: place.of(array) for name, place in places.items() if name in requested}, tuple(places), {})


def _why(error: Exception) -> str:
    """NumPy's reason in brackets; where it advises to load Python objects it took another kind of file for them."""
    text = (str(error).splitlines() or [""])[0]
    return f" ({text})" if text and "pickle" not in text else ""


def write_npz(table: SignalTable, path: Path) -> None:
    """Write arrays by name, and the metadata as JSON."""
    arrays: dict[str, Any] = {"metadata": np.array(json.dumps(table.metadata)), **table.columns}
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_parquet(path: Path, requested: Collection[str]) -> LogColumns:
    """Read columns by name."""
    import pyarrow
    from pyarrow import parquet

    try:
        schema = parquet.read_schema(path)
        _check_names(path, schema.names)
        table = parquet.read_table(path, columns=[name for name in requested if name in schema.names])
        columns = {name: table[name].to_numpy() for name in table.column_names}
    except pyarrow.ArrowException as error:
        raise _not_numbers(path, error) from None
    noted = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items() if key != b"ARROW:schema"}
    return LogColumns(columns, schema.names, {key: _number(value) for key, value in noted.items()})


def parquet_blocks(path: Path, requested: Collection[str]) -> Iterator[LogColumns]:
    """Read columns by name, a part of the rows at a time."""
    import pyarrow
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as file:
            names = file.schema_arrow.names
            _check_names(path, names)
            for batch in file.iter_batches(_ROWS, columns=[name for name in requested if name in names]):
                columns = {name: batch[name].to_numpy(zero_copy_only=False) for name in batch.schema.names}
                yield LogColumns(columns, names, {})
    except pyarrow.ArrowException as error:
        raise _not_numbers(path, error) from None


def _check_names(path: Path, names: Sequence[str]) -> None:
    double = next((name for place, name in enumerate(names) if name in names[:place]), None)
    if double is not None:
        raise InvalidInput(f"log {path}: has two columns {double!r}: each needs a name of its own")


def write_parquet(table: SignalTable, path: Path) -> None:
    """Write columns by name."""
    import pyarrow
    from pyarrow import parquet

    described = {key: value if isinstance(value, str) else json.dumps(value) for key, value in table.metadata.items()}
    parquet.write_table(pyarrow.table(dict(table.columns)).replace_schema_metadata(described), path)


def _not_numbers(path: Path, error: Exception) -> InvalidInput:
    return InvalidInput(f"log {path}: is not a parquet file of numbers ({str(error).splitlines()[0]})")


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text
