"""`servotwin commission`: an axis file from logs of a drive's command and position."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from servotwin.cli.commission_json import WORDS, as_dict, units_of
from servotwin.commissioning.commission import CommissionedAxis, commission
from servotwin.commissioning.scenario_file import scenario_of
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.inverse_dynamics.closed_loop import FittedLaw
from servotwin.estimation.inverse_dynamics.fit import ParameterFit
from servotwin.estimation.inverse_dynamics.fitted_pid import FittedPid
from servotwin.estimation.inverse_dynamics.identify import GivenLaw
from servotwin.logs.drive_recordings import DriveColumns
from servotwin.plant.axis import Axis
from servotwin.runtime import files

_DECIMALS = 8  # smaller numbers are shown with a power of ten


@dataclass(frozen=True)
class CommissionOptions:
    """The command's options, in SI but for the largest gap: mm, of a rotary axis deg."""

    logs: Sequence[Path]
    columns: DriveColumns
    gains: GivenLaw
    inertia: float | None = None
    feedback: str = "motor"
    applied: bool = False
    crossover: float | None = None
    output: Path | None = None
    scenario: Path | None = None
    largest_gap: float | None = None
    page: Path | None = None
    as_json: bool = False


def show(options: CommissionOptions) -> None:
    """Identify, write the files that are asked for, and print what was found.

    Raises
    ------
    InvalidInput
        As `commission`; a file cannot be written; no controller is known for the axis file.
    """
    _check_files(options)
    console = Console(stderr=options.as_json)
    with console.status("reading and fitting"):
        found = commission(
            options.logs,
            options.columns,
            gains=options.gains,
            inertia=options.inertia,
            feedback=options.feedback,
            applied=options.applied,
            crossover=options.crossover,
        )
    texts = _texts(options, found)
    if options.page is not None:
        from servotwin.cli.commission_page import write_page

        write_page(options.page, found, headline(found))
    for path, text in texts.items():
        with files.atomic_output(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    if options.as_json:
        print(json.dumps(as_dict(found), indent=2, allow_nan=False))
        return
    _print(console, found)
    for path in (*texts, *((options.page,) if options.page is not None else ())):
        console.print(f"written: {path}", highlight=False)


def _check_files(options: CommissionOptions) -> None:
    for path in (options.output, options.scenario):
        if path is not None:
            files.check_file(path, (".toml",))
    if options.page is not None:
        from servotwin.report.panels import check_page

        check_page(options.page)
    if options.scenario is not None and (options.output is None or options.largest_gap is None):
        raise InvalidInput("servotwin commission: --scenario needs -o, the axis that it names, and --largest-gap")
    if options.output is not None and options.scenario is not None and options.output.parent != options.scenario.parent:
        raise InvalidInput(f"--scenario {options.scenario}: must be in the folder of {options.output}, which it names")


def _texts(options: CommissionOptions, found: CommissionedAxis) -> dict[Path, str]:
    """Texts of the files to be written."""
    if options.output is None:
        return {}
    axis = found.axis
    if axis is None:
        source, doubts = found.logs[0].recording.source, "; ".join(found.drive.doubts)
        raise InvalidInput(
            f"{source}: an axis file holds the controller that ran, which the log does not show: {doubts}; "
            "give --reference COLUMN, or --position-gain and --velocity-gain, or --kp and --kd"
        )
    texts = {options.output: axis_text(found, axis)}
    if options.scenario is not None and options.largest_gap is not None:
        texts[options.scenario] = scenario_of(found, options.output, options.largest_gap)
    return texts


def axis_text(found: CommissionedAxis, axis: Axis) -> str:
    """The axis file, with how sure its numbers are in comments."""
    fit, unit = found.best, found.logs[0].recording.force_unit
    known, names = (
        found.uncertainty,
        ", ".join(Path(log.recording.source.removeprefix("log ")).name for log in found.logs),
    )
    lines = [
        f"# Identified by servotwin commission from {names}.",
        *(f"# {line} (95 %)" for line in _lines(found, fit)),
        "# For the twin, at the motor (95 %): [twin.uncertainty]",
        *(
            [f"#   {', '.join(f'{name}_percent = {100.0 * getattr(known, name):.3g}' for name in 'mkc')},"]
            if found.drive.split is not None
            else []
        ),
        f"#   k_t_percent = {100.0 * known.k_T:.3g}, k_b_percent = {100.0 * known.k_B:.3g},",
        f"#   friction_n_m = [{known.friction[0]:.4g}, {known.friction[1]:.4g}], "
        f"input_bias_n_m = [{known.input_bias[0]:.4g}, {known.input_bias[1]:.4g}]",
    ]
    if found.force_per_command is None:
        lines.append(f"# No scale of the command was known: where the keys say N or N m they count {unit}.")
    return "\n".join(lines) + "\n\n" + axis.dumps()


def headline(found: CommissionedAxis) -> str:
    """The result in one line."""
    return ", ".join(_lines(found, found.best)) + " (± 95 %)"


def _lines(found: CommissionedAxis, fit: ParameterFit) -> list[str]:
    units = units_of(found)
    return [*(f"{WORDS[name]} {_number(fit, name)} {units[name]}" for name in fit.names), *_frictions(found)]


def _frictions(found: CommissionedAxis) -> list[str]:
    """The friction at the mean and the largest speed."""
    recording = found.logs[0].recording
    return [
        f"friction at {each.speed:.3g} {recording.unit}/s ({which}) {_rounded(each.force, each.half_width)} "
        f"{recording.force_unit}"
        for each, which in zip(found.drive.friction, ("the mean speed", "the largest"), strict=True)
    ]


def _number(fit: ParameterFit, name: str) -> str:
    """A parameter with half of its 95 % interval."""
    return _rounded(fit[name], fit.half_width(name))


def _rounded(value: float, half: float) -> str:
    """A number with half of its interval, both to the interval's second digit."""
    decimals = 1 - math.floor(math.log10(half)) if 0.0 < half < math.inf else _DECIMALS + 1
    if decimals > _DECIMALS:
        return f"{value:.6g} ± {half:.2g}"
    return " ± ".join(f"{round(each, decimals):.{max(0, decimals)}f}" for each in (value, half))


def _print(console: Console, found: CommissionedAxis) -> None:
    drive = found.drive
    for log, band in zip(found.logs, drive.bands, strict=True):
        recording = log.recording
        name = recording.source.removeprefix("log ")
        parts = ", ".join(f"{part}: {column}" for part, column in log.columns.items())
        console.print(
            f"{name}: {recording.duration:.4g} s at {recording.rate:g} Hz ({parts})", markup=False, highlight=False
        )
        for defect, count in log.found.items():
            console.print(f"  {defect}: {count}", style="dim", highlight=False)
        console.print(
            f"  motion up to {band.motion:.3g} Hz; low-pass at {band.corner:.3g} Hz, then one sample in "
            f"{band.decimation}",
            style="dim",
            highlight=False,
        )
    console.print(_table(found), highlight=False)
    console.print(f"{', '.join(_frictions(found))} (± 95 %)", highlight=False)
    for line in _remarks(found):
        console.print(line, highlight=False)


def _table(found: CommissionedAxis) -> Table:
    units, drive = units_of(found), found.drive
    table = Table("parameter (± 95 %)", "inverse dynamics", "simulated loop", "unit", box=None, pad_edge=False)
    refined = drive.refinement
    pairs = [
        (drive.symmetric, None if refined is None else refined.symmetric),
        (drive.asymmetric, None if refined is None else refined.asymmetric),
    ]
    for first, second in pairs:
        for name in first.names:
            if first is drive.asymmetric and name == "inertia":
                continue
            shown = "-" if second is None else _number(second, name)
            table.add_row(WORDS[name], _number(first, name), shown, units[name])
    errors = [f"{100.0 * first.relative_error:.2f}" for first, _ in pairs]
    table.add_row(
        "command not explained",
        errors[0],
        "" if refined is None else f"{100 * refined.symmetric.relative_error:.2f}",
        "%",
    )
    table.add_row("... with a friction for each way", errors[1],
                  "" if refined is None else f"{100 * refined.asymmetric.relative_error:.2f}", "%")  # fmt: skip
    return table


def _law(law: FittedLaw, found: CommissionedAxis) -> str:
    """The controller that ran, in units of the command."""
    recording, scale = found.logs[0].recording, abs(found.force_per_command or 1.0)
    unit, command = recording.unit, recording.command_unit or "command"
    left = f"all but {100 * law.left:.2g} % of the command is explained"
    if isinstance(law, FittedPid):
        return (
            f"controller: PID, {law.Kp / scale:.5g} {command}/{unit}, {law.Ki / scale:.5g} {command}/({unit} s), "
            f"{law.Kd / scale:.5g} {command} s/{unit}, filter of the derivative {1e3 * law.Tf:.3g} ms; {left}"
        )
    reset = "" if law.integral_time is None else f", integral time {law.integral_time:.4g} s"
    return (
        f"controller: position gain {law.position_gain:.5g} 1/s, velocity gain {law.velocity_gain / scale:.5g} "
        f"{command} s/{unit}{reset}, speed filter {1e3 * law.speed_filter:.3g} ms; {left}"
    )


def _remarks(found: CommissionedAxis) -> list[str]:
    drive, recording = found.drive, found.logs[0].recording
    lines = []
    if drive.law is not None and math.isfinite(drive.law.left):
        lines.append(_law(drive.law, found))
    if drive.refinement is not None:
        simulated = drive.refinement.simulated
        lines.append(
            f"simulated loop against the log: position off by {100 * simulated.position_error:.2g} %, "
            f"force by {100 * simulated.force_error:.2g} %"
        )
    lines += _shaft_lines(found)
    lines += [each for each in (drive.late, drive.elastic, drive.slip, drive.tight, drive.beside) if each]
    lines += [f"no simulation: {doubt}" for doubt in drive.doubts]
    if found.axis is None:
        lines.append(
            "no axis: the controller that ran is not known; give --position-gain and --velocity-gain, or --kp and --kd"
        )
    if found.force_per_command is None:
        lines.append(
            f"no scale of the command is known: parameters are per {recording.force_unit}; give --scale, or "
            "--inertia of all that moves"
        )
        if recording.command_unit == "V":
            lines.append(
                "resistance and torque constant of a motor cannot be told apart here: voltage and position show their "
                "quotient times inertia and friction, and back EMF as viscous friction; give --inertia, or a log with "
                "the current as --command, which shows friction and inertia without back EMF"
            )
    return [*lines, f"next experiment: {drive.advice}"]


def _shaft_lines(found: CommissionedAxis) -> list[str]:
    """Gap, resonance and delay between two encoders."""
    log, shaft, split = found.logs[0], found.drive.shaft, found.drive.split
    lines = []
    if log.lost_motion is not None:
        lost, unit = log.lost_motion, log.recording.unit
        low, high = lost.interval_load
        lines.append(
            f"lost motion at the load: {lost.at_load:.4g} {unit} (95 %: {low:.4g} .. {high:.4g}), the gap and the "
            f"wind-up by friction together{'' if lost.ok else f': {lost.status.value}'}"
        )
        if lost.ratio < 0.0:
            lines.append("the motor's encoder counts in the opposite direction of the load's: its sign was changed")
    if shaft is None:
        return lines
    if math.isnan(shaft.delay):
        return [
            *lines,
            f"shaft: taken as rigid: the encoders are coherent up to {shaft.highest:.3g} Hz, and the load follows the "
            "motor neither at once nor as one mass on a shaft does",
        ]
    delay = f"{1e3 * shaft.delay:.3g} ± {1e3 * NORMAL_95 * shaft.delay_std:.2g} ms (95 %)"
    late = f"the load's encoder is {delay} late"
    if not math.isfinite(shaft.resonance):
        return [
            *lines,
            f"shaft: the encoders are coherent up to {shaft.highest:.3g} Hz and show no elasticity; {late}",
        ]
    lines.append(
        f"shaft: resonance {shaft.resonance:.4g} ± {NORMAL_95 * shaft.resonance_std:.2g} Hz (95 %) with the motor "
        f"held, damping ratio {shaft.damping:.2g}, coherent up to {shaft.highest:.3g} Hz; {late}"
    )
    if split is not None:
        load, motor = split["load_inertia"], split["motor_inertia"]
        lines.append(
            f"shaft: {load:.4g} ± {split.half_width('load_inertia'):.2g} (95 %) behind and {motor:.4g} before it, "
            f"{units_of(found)['inertia']}; stiffness {shaft.stiffness(load):.4g}, "
            f"damping {shaft.shaft_damping(load):.4g}"
        )
    else:
        lines.append("shaft: taken as rigid: in this log its elasticity cannot be told from the gap")
    return lines
