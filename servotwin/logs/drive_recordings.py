"""Reading a recording of a drive's command and position from a log: columns, units and a uniform grid of times."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.recording import DriveRecording, Mask
from servotwin.estimation.kinematic.lost_motion import LostMotion, estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.strokes import resolution
from servotwin.estimation.kinematic.travel import ANGLES, LENGTHS
from servotwin.logs.cleaning import cleaned
from servotwin.logs.clocks import LogClock, check_rate
from servotwin.logs.log import read_columns
from servotwin.logs.names import divided_unit, given_column, guessed_column, known_unit, named_unit
from servotwin.logs.recordings import CUT, TIME_NAMES, TURNED, check_left, check_one_log, is_newest_first, numbers_of
from servotwin.plant.signals import Array

_LEAST = 500  # samples
_OVERFLOW, _OVERFLOWS = 0.7, 2  # of a column's range, and so many times
_SPIKE = 5  # samples: jumps closer together are a spike
_SAME = math.log(1.2)  # of two ways
_OTHER_UNIT = math.log(20.0)  # of two ways; a radian is 57.3 degrees
_HELD = 2.5  # usual intervals: nothing is known of the motion within a longer one
_POSITIONS = {**LENGTHS, **ANGLES}
_COMMANDS = {"v": "V", "a": "A", "n": "N", **dict.fromkeys(("n m", "nm", "n_m", "n·m"), "N m")}
_GUESSES = {
    "time": TIME_NAMES,
    "motor": ("motor", "theta_m", "motor_position", "motor_angle", "qm", "motor_pos", "position", "q"),
    "command": ("command", "voltage", "torque", "current", "force", "vir", "u"),
    "reference": ("reference", "setpoint", "target", "qg", "demand", "ref"),
    "load": ("load", "load_position", "joint", "load_angle", "load_pos", "table", "scale"),
}
_PARTS = ("time", "motor", "command", "reference", "load")


@dataclass(frozen=True)
class DriveColumns:
    """Columns of a drive's log as the user names them; None: found by their names, or absent (reference, load, time).

    Attributes
    ----------
    motor, command, reference, load, time : str or None
    rate : float or None
        Hz, of a log without times.
    motor_unit, command_unit, reference_unit, load_unit, time_unit : str or None
        Where the header does not say them; the reference's is the motor's, or the load's where there is one.
    force_per_command : float or None
        N (of a rotary axis N m) at the load per unit of the command.
    travel : float or None
        m (rotary: rad) of the load per radian of the motor.
    """

    motor: str | None = None
    command: str | None = None
    reference: str | None = None
    load: str | None = None
    time: str | None = None
    rate: float | None = None
    motor_unit: str | None = None
    command_unit: str | None = None
    reference_unit: str | None = None
    load_unit: str | None = None
    force_per_command: float | None = None
    travel: float | None = None
    time_unit: str | None = None


@dataclass(frozen=True, eq=False)
class DriveLog:
    """A recording, the columns it was read from, the travel per radian of the motor, and defects that were mended.

    Attributes
    ----------
    recording : DriveRecording
    columns : mapping
        Name of each part's column.
    travel : float or None
        m (rotary: rad) per radian of the motor; None: unknown, the log counts the motor at the load.
    found : mapping
        Number of samples by defect, in words.
    lost_motion : LostMotion or None
        Between the two encoders, rad or m of the motor; None: there is one encoder.
    """

    recording: DriveRecording
    columns: Mapping[str, str]
    travel: float | None
    found: Mapping[str, int]
    lost_motion: LostMotion | None = None


def read_drive_log(path: Path, wanted: DriveColumns) -> DriveLog:
    """Read, find columns, clean, convert to SI at the load and lay on a uniform grid.

    Raises
    ------
    InvalidInput
        The file cannot be read, a column is missing or no numbers, a unit is unknown, or too few samples are left.
    """
    chosen: dict[str, str] = {}

    def choose(names: Sequence[str]) -> Collection[str]:
        chosen.update(_chosen(path, tuple(names), wanted))
        return chosen.values()

    table = read_columns(path, choose)
    arrays = {part: numbers_of(path, name, table) for part, name in chosen.items()}
    sizes = {values.size for values in arrays.values()}
    if len(sizes) > 1:
        raise InvalidInput(
            f"log {path}: its columns {', '.join(chosen.values())} have different lengths: one table is needed"
        )
    units = {part: _unit(path, part, chosen, wanted) for part in chosen}
    for part in {"motor", "load", "reference"}.intersection(arrays):
        units[part], parts = divided_unit(path, units[part])
        arrays[part] = arrays[part] / parts
    clock = LogClock(path, units.get("time", ""), wanted.rate)
    size = sizes.pop()
    time = clock.seconds(arrays.pop("time", None), size)
    turned = is_newest_first(time)
    if turned:
        time, arrays = time[::-1], {part: values[::-1] for part, values in arrays.items()}
    for part in {"motor", "load"}.intersection(arrays):
        if units[part] in LENGTHS:
            _check_counter(path, part, chosen[part], arrays[part])
    turns = {part: 2.0 * math.pi / ANGLES[units[part]] for part in arrays if units[part] in ANGLES}
    try:
        clean = cleaned(time, arrays, turns)
    except InvalidInput as error:
        raise InvalidInput(f"log {path}: {error}") from None
    check_one_log(path, clean, clock)
    check_left(path, clean, size, table.damaged, _LEAST)
    grid, usable, rate = _grid(clean.time)
    channels = {part: np.interp(grid, clean.time, values) for part, values in clean.channels.items()}
    others = {CUT: int(table.ends_within_line), TURNED: size if turned else 0}
    found = {**clean.found, **clock.found, **{defect: count for defect, count in others.items() if count}}
    # Between samples that lie off the grid there are values finer than a count.
    counts = {part: resolution(np.unique(values)) for part, values in clean.channels.items()}
    used = {part: name for part, name in chosen.items() if part != "time" or wanted.rate is None}
    log = DriveLog(None, used, None, found)  # type: ignore[arg-type]
    return _in_si(path, channels, counts, units, (grid, usable, rate), wanted, log)


def _in_si(
    path: Path,
    channels: dict[str, Array],
    counts: Mapping[str, float],
    units: Mapping[str, str],
    grid: tuple[Array, Mask, float],
    wanted: DriveColumns,
    log: DriveLog,
) -> DriveLog:
    """Convert all positions to those of the load, and the command to a force where its scale is known."""
    _check_kinds(path, units, log.columns)
    for part in ("motor", "reference", "load"):
        if part in channels:
            channels[part] = channels[part] * _POSITIONS[units[part]]
    output = units.get("load", units.get("reference", units["motor"]))
    rotary, motor, turned = output in ANGLES, channels["motor"], units["motor"] in ANGLES
    time, usable, rate = grid
    travel, lost = wanted.travel, None
    if "load" in channels:
        lost = estimate_lost_motion(EncoderRecording(time, motor, channels["load"], None, "rad", "", f"log {path}"))
        # Of two lengths the ratio is no travel per radian.
        travel = abs(lost.ratio) if turned and travel is None and math.isfinite(lost.ratio) else travel
    if turned and not rotary and travel is None:
        raise InvalidInput(
            f"log {path}: column {log.columns['motor']!r} is an angle and {output!r} is a length: give --lead-mm, the "
            "travel per turn of the motor"
        )
    ratio = travel if turned and travel is not None else 1.0
    against = lost is not None and lost.ratio < 0.0
    motor = motor * (-ratio if against else ratio)
    if "reference" in channels:
        _check_reference(path, log.columns["reference"], channels["reference"], motor, ratio)
    scale = _force_scale(path, units["command"], rotary, travel if turned or not rotary else None, wanted)
    scale = -scale if scale is not None and against and wanted.force_per_command is None else scale
    recording = DriveRecording(
        rate=rate,
        position=motor,
        force=channels["command"] * (1.0 if scale is None else scale),
        usable=usable,
        reference=channels.get("reference"),
        load=channels.get("load"),
        rotary=rotary,
        force_per_command=scale,
        resolution=counts["motor"] * _POSITIONS[units["motor"]] * ratio,
        load_resolution=counts["load"] * _POSITIONS[units["load"]] if "load" in counts else 0.0,
        command_unit=units["command"],
        source=f"log {path}",
    )
    return replace(log, recording=recording, travel=travel, lost_motion=lost)


def _check_counter(path: Path, part: str, column: str, values: Array) -> None:
    """Refuse lengths of a counter that overflows: they jump by most of their range, and not back at once."""
    known = values[np.isfinite(values)]
    jumps = np.flatnonzero(np.abs(np.diff(known)) > _OVERFLOW * np.ptp(known)) if known.size else known
    alone = np.diff(jumps, prepend=-np.inf) > _SPIKE
    alone &= np.diff(jumps, append=np.inf) > _SPIKE
    count = int(np.sum(alone))
    # Rows in disorder jump everywhere.
    if count >= max(_OVERFLOWS, jumps.size // 2):
        raise InvalidInput(
            f"log {path}: column {column!r} jumps by most of its range of {np.ptp(known):.4g} {count} times: its "
            f"counter overflows; make it one length, or, if it counts turns, say so (--{part}-unit rev/4096), and they "
            "are counted"
        )


def _check_kinds(path: Path, units: Mapping[str, str], columns: Mapping[str, str]) -> None:
    """Refuse an angle where the others are lengths; only the motor's may be one."""
    lengths = [part for part in ("motor", "load", "reference") if units.get(part) in LENGTHS]
    angles = [part for part in ("reference", "load") if units.get(part) in ANGLES]
    if lengths and angles:
        raise InvalidInput(
            f"log {path}: column {columns[angles[0]]!r} is an angle ({units[angles[0]]}) and "
            f"{columns[lengths[0]]!r} is a length ({units[lengths[0]]}): reference and load must be of one kind, and "
            f"of a motor that counts lengths; give --{angles[0]}-unit or --{lengths[0]}-unit where a header is wrong"
        )


def _check_reference(path: Path, column: str, reference: Array, position: Array, ratio: float) -> None:
    """Refuse a reference that moves as the motor does, and not as the load (`position`), or in another unit."""
    ways = float(np.ptp(reference)), float(np.ptp(position))
    if min(ways) <= 0.0:
        return
    moved = ways[0] / ways[1]
    if abs(math.log(moved * ratio)) < _SAME < abs(math.log(moved)):
        raise InvalidInput(
            f"log {path}: column {column!r} moves as far as the motor, {moved:.4g} times as far as the load: convert "
            "it to the load, or leave out --ratio and --lead-mm, and all parameters count at the motor"
        )
    if abs(math.log(moved)) > _OTHER_UNIT:
        raise InvalidInput(
            f"log {path}: column {column!r} moves {moved:.4g} times as far as the position: one of them has another "
            "unit; give --reference-unit or --motor-unit"
        )


def _force_scale(path: Path, unit: str, rotary: bool, travel: float | None, wanted: DriveColumns) -> float | None:
    given = wanted.force_per_command
    if given is not None:
        if not (math.isfinite(given) and given != 0.0):
            raise InvalidInput(
                f"log {path}: --scale {given!r}: must be finite and not 0; negative turns the command's sign"
            )
        return given
    if unit == "N" and not rotary:
        return 1.0
    if unit == "N m":
        # A torque of the motor, whose load travels by so much per radian.
        return 1.0 if travel is None and rotary else (None if travel is None else 1.0 / travel)
    return None


def _grid(time: Array) -> tuple[Array, Mask, float]:
    """Uniform times, where samples were near, and the rate."""
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    regular = intervals[intervals < _HELD * usual]
    # The mean is finer than the clock of the log.
    rate = float(f"{1.0 / float(regular.mean()):.6g}")
    grid = time[0] + np.arange(int((time[-1] - time[0]) * rate * (1.0 + 1e-9)) + 1) / rate
    after = np.clip(np.searchsorted(time, grid), 1, time.size - 1)
    return grid, intervals[after - 1] < _HELD * usual, rate


def _chosen(path: Path, names: tuple[str, ...], wanted: DriveColumns) -> dict[str, str]:
    """Name of the column of each part."""
    check_rate(path, wanted.time, wanted.time_unit, wanted.rate)
    result: dict[str, str] = {}
    for part in _PARTS:
        given: str | None = getattr(wanted, part)
        name = guessed_column(_GUESSES[part], names) if given is None else given_column(path, part, given, names)
        if name is not None:
            result[part] = name
        elif part in ("motor", "command"):
            what = "position of the motor" if part == "motor" else "command to the drive (torque, current, voltage)"
            raise InvalidInput(
                f"log {path}: no column is named like the {what}; give --{part} COLUMN, one of "
                f"{', '.join(names) or 'none'}"
            )
    used = list(result.values())
    for part, name in result.items():
        if used.count(name) > 1:
            raise InvalidInput(f"log {path}: column {name!r} is named twice, once as --{part}: each part needs its own")
    return result


def _unit(path: Path, part: str, chosen: Mapping[str, str], wanted: DriveColumns) -> str:
    """Unit of a column: as given, as the header says, or as that of the encoder that it refers to."""
    given: str | None = getattr(wanted, f"{part}_unit", None)
    unit = known_unit(given) if given else named_unit(chosen[part])
    if part == "command":
        return _COMMANDS.get(unit.lower(), unit)
    if part == "time":
        return unit
    if not unit and part == "reference":
        return _unit(path, "load" if "load" in chosen else "motor", chosen, wanted)
    if divided_unit(path, unit)[0] not in _POSITIONS:
        shown = f"is in {unit!r}" if unit else "does not say its unit"
        raise InvalidInput(
            f"log {path}: column {chosen[part]!r} {shown}: give --{part}-unit, one of {', '.join(_POSITIONS)}, or "
            "of counts the part of one, such as rev/4096"
        )
    return unit
