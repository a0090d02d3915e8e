"""Registry of log formats: one entry each with its reader and its writer. A new format is a file and an entry here."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from servotwin.errors import InvalidInput
from servotwin.logs.binary_files import parquet_blocks, read_npy, read_npz, read_parquet, write_npz, write_parquet
from servotwin.logs.columns import LogColumns, Requested, SignalTable
from servotwin.logs.csv_file import csv_blocks, read_csv, write_csv
from servotwin.logs.epics_file import looks_like_epics, read_epics
from servotwin.logs.hdf5_file import read_hdf5
from servotwin.logs.matlab_file import read_matlab
from servotwin.logs.mcap_file import read_mcap
from servotwin.logs.mdf_file import read_mdf
from servotwin.logs.tdms_file import read_tdms


class LogFormat(NamedTuple):
    """One format: its reader, its writer, and the library that it needs.

    Attributes
    ----------
    read : callable
        (path, requested column names) -> `LogColumns`.
    write : callable or None
        (table, path) -> None; None: the format is only read.
    library, extra : str
        Module that must be installed, and the extra of servotwin that installs it; empty: none.
    blocks : callable or None
        As `read`, a part of the rows at a time; None: the format is read whole.
    chooses : bool
        True where `read` and `blocks` take a choice among the names too: the names are known only once the whole file
        is read, or cost little.
    """

    read: Callable[[Path, Any], LogColumns]
    write: Callable[[SignalTable, Path], None] | None = None
    library: str = ""
    extra: str = ""
    blocks: Callable[[Path, Any], Iterator[LogColumns]] | None = None
    chooses: bool = False

    def check_installed(self, file: str) -> None:
        """Raise InvalidInput where the format's library is missing; `file` is the file in words."""
        if self.library and importlib.util.find_spec(self.library) is None:
            kind = self.extra
            raise InvalidInput(
                f"{file}: {kind} needs {self.library}; give: pip install 'servotwin[{kind}]', or use .npz"
            )


def _is_epics(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = [line for _, line in zip(range(20), file, strict=False)]
    return sum(map(looks_like_epics, lines)) > len(lines) // 2


def _read_text(path: Path, requested: Requested) -> LogColumns:
    """Read text of any kind: lines of EPICS, or a table."""
    return (read_epics if _is_epics(path) else read_csv)(path, requested)


def _text_blocks(path: Path, requested: Requested) -> Iterator[LogColumns]:
    return iter([read_epics(path, requested)]) if _is_epics(path) else csv_blocks(path, requested)


_HDF5 = LogFormat(read_hdf5, library="h5py", extra="hdf5", chooses=True)
_MDF = LogFormat(read_mdf, library="asammdf", extra="mdf")
FORMATS: Mapping[str, LogFormat] = {
    ".csv": LogFormat(read_csv, write_csv, blocks=csv_blocks, chooses=True),
    ".npz": LogFormat(read_npz, write_npz),
    ".npy": LogFormat(read_npy),
    ".parquet": LogFormat(read_parquet, write_parquet, library="pyarrow", extra="parquet", blocks=parquet_blocks),
    ".txt": LogFormat(_read_text, blocks=_text_blocks, chooses=True),
    ".tsv": LogFormat(read_csv, blocks=csv_blocks, chooses=True),
    ".dat": LogFormat(_read_text, blocks=_text_blocks, chooses=True),
    ".mat": LogFormat(read_matlab, chooses=True),
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".mf4": _MDF,
    ".mdf": _MDF,
    ".tdms": LogFormat(read_tdms, library="nptdms", extra="tdms"),
    ".mcap": LogFormat(read_mcap, library="mcap", extra="mcap", chooses=True),
}
WRITTEN = tuple(suffix for suffix, each in FORMATS.items() if each.write)
"""Suffixes of the formats that can be written."""
