"""MATLAB files: versions 5 to 7.2 by scipy, version 7.3 as the HDF5 file that it is."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.columns import LogColumns
from servotwin.logs.hdf5_file import read_hdf5

_HDF5 = b"\x89HDF\r\n\x1a\n"


def read_matlab(path: Path, requested: Collection[str]) -> LogColumns:
    """Read the numeric arrays; row or column i of a matrix is called name[i], counted from 0."""
    with path.open("rb") as file:
        head = file.read(1024)
    if head[512:520] == _HDF5 or head.startswith(_HDF5):
        return read_hdf5(path, requested)
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        # mat_dtype: what MATLAB holds as double is read as double.
        arrays = loadmat(path, mat_dtype=True)
    except (MatReadError, ValueError, TypeError, NotImplementedError, EOFError) as error:
        raise InvalidInput(
            f"log {path}: is not a MATLAB file that can be read ({str(error).splitlines()[0]})"
        ) from None
    columns = columns_of({name: array for name, array in arrays.items() if not name.startswith("__")})
    return LogColumns({name: columns[name] for name in columns if name in requested}, tuple(columns), {})


def columns_of(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Vectors by name, and the longer direction of matrices as name[i]."""
    result: dict[str, Any] = {}
    for name, array in arrays.items():
        if not (isinstance(array, np.ndarray) and array.dtype.kind in "fiu"):
            continue
        squeezed = np.squeeze(array)
        if squeezed.ndim == 1 and squeezed.size > 1:
            result[name] = squeezed
        elif squeezed.ndim == 2:
            rows = squeezed if squeezed.shape[0] < squeezed.shape[1] else squeezed.T
            result |= {f"{name}[{place}]": row for place, row in enumerate(rows)}
    return result
