"""`servotwin simulate` and `convert`: run a scenario and write its signals, or a log in another format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import servotwin as st
from servotwin.cli.loop_report import reasons, summary, window_table
from servotwin.cosim import Loop
from servotwin.cosim.scenario import PRESETS, preset_text
from servotwin.errors import InvalidInput
from servotwin.logs.columns import SignalTable
from servotwin.logs.log import check_output, read_log, write_log
from servotwin.logs.recordings import RecordingColumns, read_recording
from servotwin.runtime import files

_PICTURES = (".png", ".svg")


def record(
    scenario: Path,
    output: Path | None = None,
    console: Console | None = None,
    figure: Path | None = None,
    windows: bool = False,
) -> Path | None:
    """Run a scenario file, show what its twin found, and write its signals.

    Parameters
    ----------
    scenario : Path
        A scenario's TOML, or the name of a packaged one.
    output : Path, optional
        NAME.parquet (needs the extra `parquet`), NAME.npz or NAME.csv (12 significant digits, metadata in the first row
        of a last column).
    console : Console, optional
        Where the report is shown; progress is shown on the standard error.
    figure : Path, optional
        NAME.png or NAME.svg.
    windows : bool
        Show a line for each window.

    Returns
    -------
    Path or None
        The file of the signals.

    Raises
    ------
    InvalidInput
        Before anything is computed: an output that cannot be written, a scenario that is not valid.
    """
    if output is not None:
        check_output(output)
    if figure is not None:
        files.check_file(figure, _PICTURES)
    console = console or Console()
    text, loop = _run(scenario)
    for line in summary(loop):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if windows and loop.windows:
        console.print(window_table(loop))
        for line in reasons(loop):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
    if output is not None:
        table = recording(loop, text)
        write_log(table, output)
        console.print(f"{len(table.columns['time_s'])} samples: {output}", soft_wrap=True, highlight=False)
    if figure is not None:
        with files.atomic_output(figure) as temporary:
            loop.plot().savefig(temporary, format=figure.suffix[1:], dpi=150)
        console.print(f"figure: {figure}", soft_wrap=True, highlight=False)
    return output


def convert(log: Path, output: Path) -> Path:
    """Write a log in another format, with the channels that windows are made of; the drive "replay" reads .csv only.

    Raises
    ------
    InvalidInput
        The log is not one, or the output cannot be written.
    """
    _check_another_file(log, output)
    write_log(read_log(log).table(), output)
    return output


def _check_another_file(log: Path, output: Path) -> None:
    check_output(output)
    if log.resolve() == output.resolve():
        raise InvalidInput(f"output {output}: is the log itself, which would be lost: give another name")


def convert_recording(log: Path, output: Path, columns: RecordingColumns) -> Mapping[str, int]:
    """Write the cleaned samples of a foreign log, and return the number of its defects, in words.

    Raises
    ------
    InvalidInput
        The log is not one, or the output cannot be written.
    """
    _check_another_file(log, output)
    read = read_recording(log, columns)
    made = read.recording
    table = {"time_s": made.time, f"motor [{made.motor_unit}]": made.motor, f"load [{made.load_unit}]": made.load}
    if made.command is not None:
        table["command"] = made.command
    write_log(SignalTable(table, {}), output)
    return read.found


def recording(loop: Loop, scenario_text: str) -> SignalTable:
    """Make the table of a co-simulation."""
    run, scenario = loop.run, loop.scenario
    metadata = {
        "servotwin": st.__version__,
        "name": scenario.name,
        "model": scenario.servo.version,
        "servo": scenario.servo.dumps(),
        "seed": scenario.seed,
        "sample_rate_hz": run.sample_rate,
        "window_s": scenario.commissioning.window,
        "pre_trigger_s": scenario.commissioning.pre_trigger,
        "scenario": scenario_text,
    }
    return SignalTable(run.columns, metadata)


def read_scenario(path: Path) -> tuple[str, st.Scenario]:
    """Read a scenario and its text: a file, or the name of a packaged one."""
    if str(path) in PRESETS and not path.exists():
        return preset_text(str(path)), st.Scenario.preset(str(path))
    scenario = st.Scenario.load(path)
    return path.read_text(encoding="utf-8"), scenario


def _run(scenario: Path) -> tuple[str, Loop]:
    """Read and co-simulate a scenario under a progress bar."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"))
    console = Console(stderr=True)
    with Progress(
        *columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        bar = progress.add_task("looking for a verified fallback set", total=None)
        text, described = read_scenario(scenario)
        progress.update(bar, description="simulating", total=1.0)
        return text, st.cosimulate(described, lambda share: progress.update(bar, completed=share))
