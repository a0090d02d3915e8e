"""HDF5 files: every numeric data set is a column, named by its path."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import LogColumns
from servotwin.runtime.extras import require

_MOST_ROWS = 64  # of a matrix, each of which is a column


def read_hdf5(path: Path, requested: Collection[str]) -> LogColumns:
    """Read data sets by their path without the first slash; row or column i of a matrix is called name[i]."""
    h5py = require("h5py", f"log {path}")
    places: dict[str, tuple[str, int | None, bool]] = {}

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "fiu" or name.startswith("#"):
            return
        shape = tuple(size for size in item.shape if size != 1)
        if len(shape) == 1:
            places[name] = (name, None, False)
        elif len(shape) == 2 and min(shape) <= _MOST_ROWS:
            flat = shape[0] < shape[1]
            places.update({f"{name}[{i}]": (name, i, flat) for i in range(min(shape))})

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
            values = {name: _column(file, *place) for name, place in places.items() if name in requested}
    except OSError as error:
        raise InvalidInput(f"log {path}: is not an HDF5 file that can be read ({str(error).splitlines()[0]})") from None
    return LogColumns(values, tuple(places), {})


def _column(file: Any, name: str, row: int | None, flat: bool) -> Any:
    data = file[name]
    if row is None:
        return np.ravel(data[()])
    return np.squeeze(data[()])[row] if flat else np.squeeze(data[()])[:, row]
