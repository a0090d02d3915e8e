"""HDF5 files: every numeric data set is a column, named by its path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from servotwin.errors import InvalidInput
from servotwin.logs.columns import ColumnPlace, LogColumns, Requested, among, places_of
from servotwin.logs.own_times import with_unit
from servotwin.runtime.extras import require

_UNITS = ("unit", "units", "Unit", "Units")


def read_hdf5(path: Path, requested: Requested) -> LogColumns:
    """Read data sets by their path without the first slash; matrices and records as `places_of` calls their columns.

    An attribute `unit` or `units` of a data set stands in brackets behind the name.
    """
    h5py = require("h5py", f"log {path}")
    places: dict[str, ColumnPlace] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiuV" and not name.startswith("#"):
            unit = _unit(item.attrs)
            places.update({with_unit(each, unit): at for each, at in places_of(name, item.shape, item.dtype).items()})

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
            requested = among(requested, tuple(places))
            values = {name: place.of(file[place.array]) for name, place in places.items() if name in requested}
    except OSError as error:
        raise InvalidInput(f"log {path}: is not an HDF5 file that can be read ({str(error).splitlines()[0]})") from None
    return LogColumns(values, tuple(places), {})


def _unit(attributes: Any) -> str:
    """Unit of a data set as its attributes say it; empty where they do not."""
    value = next((attributes[name] for name in _UNITS if name in attributes), "")
    value = value[0] if getattr(value, "size", 0) == 1 and getattr(value, "shape", ()) else value
    return value.decode(errors="replace") if isinstance(value, bytes) else value if isinstance(value, str) else ""
