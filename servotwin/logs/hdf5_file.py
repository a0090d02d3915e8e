"""HDF5 files: every numeric data set is a column, named by its path."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from servotwin.errors import InvalidInput
from servotwin.logs.columns import ColumnPlace, LogColumns, places_of
from servotwin.runtime.extras import require


def read_hdf5(path: Path, requested: Collection[str]) -> LogColumns:
    """Read data sets by their path without the first slash; matrices and records as `places_of` calls their columns."""
    h5py = require("h5py", f"log {path}")
    places: dict[str, ColumnPlace] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiuV" and not name.startswith("#"):
            places.update(places_of(name, item.shape, item.dtype))

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
            values = {name: place.of(file[place.array]) for name, place in places.items() if name in requested}
    except OSError as error:
        raise InvalidInput(f"log {path}: is not an HDF5 file that can be read ({str(error).splitlines()[0]})") from None
    return LogColumns(values, tuple(places), {})
