"""Reading a recording of a drive's command and position from a log: columns, units and a uniform grid of times."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from servotwin.config.table import did_you_mean
from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.recording import DriveRecording, Mask
from servotwin.estimation.kinematic.lost_motion import LostMotion, estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.strokes import resolution
from servotwin.logs.cleaning import cleaned
from servotwin.logs.log import read_columns
from servotwin.logs.recordings import CUT, bare_name, named_unit, numbers_of, times_of
from servotwin.plant.signals import Array

_LEAST = 500  # samples
_HELD = 2.5  # usual intervals: nothing is known of the motion within a longer one
# Metres or radians per unit.
_LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0, "°": math.pi / 180.0, "rev": 2.0 * math.pi}
_POSITIONS = {**_LENGTHS, **_ANGLES}
_TORQUES = ("n m", "nm", "n_m", "n·m")
_GUESSES = {
    "time": ("time", "t", "timestamp"),
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
    motor_unit, command_unit, reference_unit, load_unit : str or None
        Where the header does not say them; the reference's is the motor's, or the load's where there is one.
    force_per_command : float or None
        N (of a rotary axis N m) at the encoder per unit of the command.
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


def travel_of(lead_mm: float | None, ratio: float | None) -> float | None:
    """Travel of the load per radian of the motor from a lead (mm per turn) or a gear ratio; None: neither is given.

    Raises
    ------
    InvalidInput
        Both are given, or a value is not positive.
    """
    if lead_mm is not None and ratio is not None:
        raise InvalidInput(f"--lead-mm {lead_mm:g} and --ratio {ratio:g}: give one of the two")
    for name, value in (("--lead-mm", lead_mm), ("--ratio", ratio)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise InvalidInput(f"{name} {value!r}: must be positive and finite")
    if lead_mm is not None:
        return lead_mm * 1e-3 / (2.0 * math.pi)
    return None if ratio is None else 1.0 / ratio


def read_drive_log(path: Path, wanted: DriveColumns) -> DriveLog:
    """Read, find columns, clean, convert to SI at the load and lay on a uniform grid.

    Raises
    ------
    InvalidInput
        The file cannot be read, a column is missing or no numbers, a unit is unknown, or too few samples are left.
    """
    names = tuple(read_columns(path, ()).names)
    chosen = _chosen(path, names, wanted)
    table = read_columns(path, tuple(chosen.values()))
    arrays = {part: numbers_of(path, name, table) for part, name in chosen.items()}
    sizes = {values.size for values in arrays.values()}
    if len(sizes) > 1:
        raise InvalidInput(
            f"log {path}: its columns {', '.join(chosen.values())} have different lengths: one table is needed"
        )
    units = {part: _unit(path, part, chosen, wanted) for part in chosen}
    time = times_of(path, arrays.pop("time", None), units.get("time", ""), wanted.rate, sizes.pop())
    clean = cleaned(
        time, arrays, {part: 2.0 * math.pi / _ANGLES[units[part]] for part in arrays if units[part] in _ANGLES}
    )
    if clean.time.size < _LEAST:
        raise InvalidInput(f"log {path}: {clean.time.size} samples can be used, of at least {_LEAST}")
    grid, usable, rate = _grid(clean.time)
    channels = {part: np.interp(grid, clean.time, values) for part, values in clean.channels.items()}
    found = {**clean.found, **({CUT: 1} if table.ends_within_line else {})}
    return _in_si(path, channels, units, (grid, usable, rate), wanted, DriveLog(None, chosen, None, found))  # type: ignore[arg-type]


def _in_si(
    path: Path,
    channels: dict[str, Array],
    units: Mapping[str, str],
    grid: tuple[Array, Mask, float],
    wanted: DriveColumns,
    log: DriveLog,
) -> DriveLog:
    """Convert all positions to those of the load, and the command to a force where its scale is known."""
    count = resolution(np.unique(channels["motor"])) * _POSITIONS[units["motor"]]
    for part in ("motor", "reference", "load"):
        if part in channels:
            channels[part] = channels[part] * _POSITIONS[units[part]]
    output = units.get("load", units.get("reference", units["motor"]))
    load_count = resolution(np.unique(channels["load"])) if "load" in channels else 0.0
    rotary, motor = output in _ANGLES, channels["motor"]
    time, usable, rate = grid
    travel, lost = wanted.travel, None
    if "load" in channels:
        lost = estimate_lost_motion(EncoderRecording(time, motor, channels["load"], None, "rad", "", f"log {path}"))
        travel = lost.ratio if travel is None and math.isfinite(lost.ratio) else travel
    turned = (units["motor"] in _ANGLES) and (travel is not None)
    if units["motor"] in _ANGLES and not rotary and travel is None:
        raise InvalidInput(
            f"log {path}: column {log.columns['motor']!r} is an angle and {output!r} is a length: give --lead-mm, the "
            "travel per turn of the motor"
        )
    if turned and travel is not None:
        motor, count = motor * travel, count * abs(travel)
    scale = _force_scale(path, units["command"], rotary, travel if turned or not rotary else None, wanted)
    recording = DriveRecording(
        rate=rate,
        position=motor,
        force=channels["command"] * (1.0 if scale is None else scale),
        usable=usable,
        reference=channels.get("reference"),
        load=channels.get("load"),
        rotary=rotary,
        force_per_command=scale,
        resolution=count,
        load_resolution=load_count,
        command_unit=units["command"],
        source=f"log {path}",
    )
    return replace(log, recording=recording, travel=travel, lost_motion=lost)


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
    if unit.lower() in _TORQUES:
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
    if wanted.rate is not None and wanted.time is not None:
        raise InvalidInput(f"log {path}: --time {wanted.time!r} and --rate {wanted.rate:g}: give one of the two")
    result: dict[str, str] = {}
    for part in _PARTS:
        name = _found(path, part, getattr(wanted, part), names)
        if name is not None:
            result[part] = name
        elif part in ("motor", "command"):
            what = "position of the motor" if part == "motor" else "command to the drive (torque, current, voltage)"
            raise InvalidInput(
                f"log {path}: no column is called like the {what}; give --{part} COLUMN, one of "
                f"{', '.join(names) or 'none'}"
            )
    used = list(result.values())
    for part, name in result.items():
        if used.count(name) > 1:
            raise InvalidInput(f"log {path}: column {name!r} is named twice, once as --{part}: each part needs its own")
    return result


def _found(path: Path, part: str, given: str | None, names: tuple[str, ...]) -> str | None:
    if given is None:
        bare = {bare_name(name).lower().replace(" ", "_"): name for name in reversed(names)}
        return next((bare[guess] for guess in _GUESSES[part] if guess in bare), None)
    fitting = [name for name in names if given in (name, bare_name(name))]
    if not fitting:
        hint = did_you_mean(given, names)
        raise InvalidInput(f"log {path}: --{part} {given!r}: there is no such column{hint}; it has {', '.join(names)}")
    return fitting[0]


def _unit(path: Path, part: str, chosen: Mapping[str, str], wanted: DriveColumns) -> str:
    """Unit of a column: as given, as the header says, or as that of the encoder that it refers to."""
    given: str | None = getattr(wanted, f"{part}_unit", None)
    unit = given or named_unit(chosen[part])
    if part in ("time", "command"):
        return unit
    if not unit and part == "reference":
        return _unit(path, "load" if "load" in chosen else "motor", chosen, wanted)
    if unit not in _POSITIONS:
        shown = f"is in {unit!r}" if unit else "does not say its unit"
        raise InvalidInput(
            f"log {path}: column {chosen[part]!r} {shown}: give --{part}-unit, one of {', '.join(_POSITIONS)}"
        )
    return unit
