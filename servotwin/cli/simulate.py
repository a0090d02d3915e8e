"""`servotwin simulate` and `convert`: a table of signals, of one scenario that is run or of a log in another format."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import servotwin as st
from servotwin.cosim import Loop
from servotwin.errors import InvalidInput
from servotwin.logs.reader import read_log
from servotwin.runtime import files

_ROWS = 20_000  # of a CSV file written at a time


@dataclass(frozen=True, eq=False)
class Recording:
    """Columns of equal length with their units in their names, and what is known of the run."""

    columns: Mapping[str, NDArray[np.float64]]
    metadata: Mapping[str, Any]


def record(scenario: Path, output: Path, console: Console | None = None) -> Path:
    """Run a scenario file and write its signals.

    Parameters
    ----------
    scenario : Path
        A scenario's TOML.
    output : Path
        NAME.parquet (needs the extra `parquet`), NAME.npz or NAME.csv (12 significant digits, metadata in a first line
        that begins with #).
    console : Console, optional
        Where progress is shown.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InvalidInput
        Before anything is computed: an output that cannot be written, a scenario that is not valid.
    """
    write = writer(output)
    text, described = _read(scenario)
    found = recording(_run(described, console or Console()), text)
    with files.atomic_output(output) as temporary:
        write(found, temporary)
    (console or Console()).print(f"{_rows(found)} samples: {output}", soft_wrap=True, highlight=False)
    return output


def convert(log: Path, output: Path) -> Path:
    """A log in another format, with what its windows are made of: a gateway replays .csv only.

    Raises
    ------
    InvalidInput
        The log is not one, or the output cannot be written.
    """
    write = writer(output)
    found = read_log(log)
    whole = found.whole
    columns = {"time_s": whole.time, "measured_position_m": whole.position}
    others = {"theta_m_rad": whole.theta_m, "voltage_v": whole.voltage, "reference_m": whole.reference}
    columns |= {name: values for name, values in others.items() if values is not None}
    with files.atomic_output(output) as temporary:
        write(Recording(columns, found.metadata), temporary)
    return output


def writer(output: Path) -> Callable[[Recording, Path], None]:
    """The function that writes files of this suffix, once everything that can be checked has been.

    Raises
    ------
    InvalidInput
        Unknown suffix, missing directory, or a format whose library is not installed.
    """
    files.check_file(output, tuple(_WRITERS))
    if output.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise InvalidInput(
            f"output {output}: parquet needs pyarrow; give: pip install 'servotwin[parquet]', or use .npz"
        )
    return _WRITERS[output.suffix]


def recording(loop: Loop, scenario_text: str) -> Recording:
    """What a co-simulation's table holds."""
    run, scenario = loop.run, loop.scenario
    columns = {
        "time_s": run.time,
        "position_m": run.position,
        "measured_position_m": run.measured_position,
        "reference_m": run.reference,
        "theta_m_rad": run.theta_m,
        "theta_d_rad": run.theta_d,
        "voltage_v": run.voltage,
        "gap_rad": run.gap,
        "tolerance_m": run.tolerance,
        **{f"q{i + 1}_m": np.ascontiguousarray(run.q[:, i]) for i in range(scenario.servo.n)},
    }
    metadata = {
        "servotwin": st.__version__,
        "name": scenario.name,
        "model": scenario.servo.version,
        "servo": scenario.servo.dumps(),
        "seed": scenario.seed,
        "sample_rate_hz": run.sample_rate,
        "window_s": scenario.window,
        "pre_trigger_s": scenario.pre_trigger,
        "scenario": scenario_text,
    }
    return Recording(columns, metadata)


def _read(path: Path) -> tuple[str, st.Scenario]:
    scenario = st.Scenario.load(path)
    return path.read_text(encoding="utf-8"), scenario


def _run(scenario: st.Scenario, console: Console) -> Loop:
    """Co-simulate under a progress bar."""
    columns = (TextColumn("simulating"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=1.0)
        return st.cosimulate(scenario, lambda share: progress.update(bar, completed=share))


def _rows(found: Recording) -> int:
    return len(found.columns["time_s"])


def _write_npz(found: Recording, path: Path) -> None:
    arrays: dict[str, Any] = {"metadata": np.array(json.dumps(found.metadata)), **found.columns}
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def _write_csv(found: Recording, path: Path) -> None:
    values = np.column_stack(list(found.columns.values()))
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"# {json.dumps(found.metadata)}\n{','.join(found.columns)}\n")
        for first in range(0, len(values), _ROWS):
            np.savetxt(file, values[first : first + _ROWS], fmt="%.12g", delimiter=",")


def _write_parquet(found: Recording, path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    table = pyarrow.table(dict(found.columns))
    described = {key: value if isinstance(value, str) else json.dumps(value) for key, value in found.metadata.items()}
    parquet.write_table(table.replace_schema_metadata(described), path)


_WRITERS: dict[str, Callable[[Recording, Path], None]] = {
    ".parquet": _write_parquet,
    ".npz": _write_npz,
    ".csv": _write_csv,
}
