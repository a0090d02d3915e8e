"""Foreign log files of one recording: every format that is read, with the defects of real ones put in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servotwin.logs.recordings import RecordingColumns
from servotwin.plant.signals import Array

MOTOR, LOAD, TIME = "M1 actual", "Scale X", "Zeit"
_TURN = 2.0 * np.pi
_DATE = np.datetime64("2026-03-01T08:00:00", "us")


def damaged(table: Array, random: np.random.Generator, wrapped: bool) -> tuple[Array, list[str]]:
    """Put defects into (n, 3) times (s), motor angles (rad) and load positions; each with a chance of its own."""
    table, names = table.copy(), []
    size, interval = len(table), float(np.median(np.diff(table[:, 0])))

    def chance(name: str, share: float = 0.35) -> bool:
        if random.random() < share:
            names.append(name)
            return True
        return False

    if wrapped and chance("wrapped"):
        table[:, 1] %= _TURN
    if chance("jitter"):
        table[:, 0] += 0.3 * interval * random.uniform(-1.0, 1.0, size)
    if chance("held"):
        # Both channels come from one slow bus, and are written faster than they change.
        table[:, 1:] = table[np.arange(size) // 3 * 3, 1:]
    if chance("events"):
        table = table[np.sort(random.choice(size, int(0.7 * size), replace=False))]
    if chance("dropouts"):
        begin = int(random.integers(len(table) // 4, len(table) // 2))
        table = np.delete(table, np.s_[begin : begin + len(table) // 50], axis=0)
    if chance("spikes"):
        places = random.choice(np.arange(10, len(table) - 10), 3, replace=False)
        table[places, 2] += 50.0 * np.ptp(table[:, 2])
    if chance("no numbers"):
        table[random.choice(len(table), 5, replace=False), 2] = np.nan
    if chance("duplicates"):
        places = np.sort(np.append(np.arange(len(table)), random.choice(len(table), 5)))
        table = table[places]
    if chance("disorder"):
        place = int(random.integers(10, len(table) - 10))
        table[[place, place + 1]] = table[[place + 1, place]]
    if chance("stale"):
        table = np.vstack([[table[0, 0] - 3600.0, 0.0, 0.0], table])
    return table, names


def _text(separator: str, comma: bool, headings: int) -> Callable[[Path, Array], RecordingColumns]:
    def write(path: Path, table: Array) -> RecordingColumns:
        heads = [f"{TIME} [s]", f"{MOTOR} [rad]", f"{LOAD} [m]"]
        prose = ["# Prüfstand 7", "Recorded by X, on rig 7"][:headings]
        rows = [separator.join("n/a" if np.isnan(x) else f"{x:.12g}" for x in row) for row in table]
        body = "\n".join(rows)
        text = "\n".join([*prose, separator.join(heads), body.replace(".", ",") if comma else body])
        path.write_text(text + "\n", encoding="utf-8")
        return RecordingColumns(motor=MOTOR, load=LOAD, time=TIME)

    return write


def _epics(path: Path, table: Array) -> RecordingColumns:
    lines = []
    for time, motor, load in table:
        stamp = str(_DATE + np.timedelta64(round(1e6 * time), "us")).replace("T", " ")
        lines += [f"RIG:M {stamp} {motor:.12g}", f"RIG:X {stamp} {'' if np.isnan(load) else f'{load:.12g}'} INVALID"]
    path.write_text("\n".join(lines) + "\n")
    return RecordingColumns(motor="RIG:M", load="RIG:X", motor_unit="rad", load_unit="m")


def _arrays(table: Array) -> Mapping[str, Any]:
    return {"time": table[:, 0], "motor": table[:, 1], "load": table[:, 2]}


_NAMED = RecordingColumns(motor_unit="rad", load_unit="m")


def _npz(path: Path, table: Array) -> RecordingColumns:
    np.savez(path, allow_pickle=False, **_arrays(table))
    return _NAMED


def _parquet(path: Path, table: Array) -> RecordingColumns:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(dict(_arrays(table))), path)
    return _NAMED


def _matlab(path: Path, table: Array) -> RecordingColumns:
    from scipy.io import savemat

    savemat(path, {"data": table.T, "note": "text"})
    return _NAMED_ROWS


_NAMED_ROWS = RecordingColumns(motor="data[1]", load="data[2]", time="data[0]", motor_unit="rad", load_unit="m")


def _hdf5(userblock: int) -> Callable[[Path, Array], RecordingColumns]:
    def write(path: Path, table: Array) -> RecordingColumns:
        import h5py

        with h5py.File(path, "w", userblock_size=userblock) as file:
            file["data"] = table
        return _NAMED_ROWS

    return write


WRITERS: Mapping[str, Callable[[Path, Array], RecordingColumns]] = {
    "plain.csv": _text(",", False, 0),
    "german.csv": _text(";", True, 2),
    "tabs.tsv": _text("\t", False, 1),
    "pipes.txt": _text("|", False, 2),
    "camonitor.txt": _epics,
    "arrays.npz": _npz,
    "table.parquet": _parquet,
    "v5.mat": _matlab,
    "v73.mat": _hdf5(512),
    "tree.h5": _hdf5(0),
}
"""By file name: writes (n, 3) times, motor angles and load positions, and says which columns they are."""
