"""MATLAB files: versions 5 to 7.2 by scipy, version 7.3 as the HDF5 file that it is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import ColumnPlace, LogColumns, Requested, among, places_of
from servotwin.logs.hdf5_file import read_hdf5

_HDF5 = b"\x89HDF\r\n\x1a\n"


def read_matlab(path: Path, requested: Requested) -> LogColumns:
    """Read numeric arrays, those of structures as `structure/field`; row or column i of a matrix is called name[i]."""
    with path.open("rb") as file:
        head = file.read(1024)
    if head[512:520] == _HDF5 or head.startswith(_HDF5):
        return read_hdf5(path, requested)
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        # mat_dtype: what MATLAB holds as double is read as double.
        arrays = loadmat(path, mat_dtype=True, simplify_cells=True)
    except (MatReadError, ValueError, TypeError, NotImplementedError, EOFError) as error:
        raise InvalidInput(
            f"log {path}: is not a MATLAB file that can be read ({str(error).splitlines()[0]})"
        ) from None
    flat = _flat({name: array for name, array in arrays.items() if not name.startswith("__")})
    places: dict[str, ColumnPlace] = {}
    for name, array in flat.items():
        places |= places_of(name, array.shape, array.dtype)
    requested = among(requested, tuple(places))
    values = {name: place.of(flat[place.array]) for name, place in places.items() if name in requested}
    return LogColumns(values, tuple(places), {})


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Numeric arrays by name, those of structures as `structure/field`."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            result |= {f"{name}/{field}": array for field, array in _flat(value).items()}
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
            result[name] = value
    return result
