"""Reading a recording of two encoders from a foreign log: which columns, which units, which times."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.strokes import resolution
from servotwin.estimation.kinematic.travel import ANGLES
from servotwin.logs.cleaning import BETWEEN, OUT_OF_ORDER, REPEATED, SAME_TIME, Cleaned
from servotwin.logs.clocks import LogClock, check_rate
from servotwin.logs.columns import LogColumns
from servotwin.logs.gathering import PARTED, THINNED, Gathering
from servotwin.logs.log import read_blocks
from servotwin.logs.names import divided_unit, given_column, guessed_column, known_unit, named_unit
from servotwin.plant.signals import Array

CUT = "last row without its end (the file may have been cut off there)"
_LEAST = 100  # samples
_BLOCK = 1_000_000  # samples that are cleaned at a time
TURNED = "samples of a log with the newest first, which was turned round"
_BACKWARDS = 0.9  # of the steps in time
_JOINED = 0.3  # of the samples: so many out of order are no accident of a clock
_LEFT = 0.3  # of the samples, at least: with fewer the log is not what it seems
_INDEX = "__index_level_0__"  # how pandas writes an index without a name
TIME_NAMES = ("time", "t", "timestamp", "time_stamp", "datetime", "date_time", "date", "zeit", "x_value", _INDEX)
"""Names of a column of times, in order of preference."""
# Names by which columns are found where none is given, in order of preference.
_GUESSES = {
    "time": TIME_NAMES,
    "motor": ("motor", "theta_m", "motor_position", "motor_angle", "qm", "motor_pos"),
    "load": ("load", "position", "measured_position", "load_position", "joint", "load_angle", "load_pos", "scale"),
    "command": ("command", "voltage", "torque", "current"),
}


@dataclass(frozen=True)
class RecordingColumns:
    """Columns of a log as the user names them; None: found by their names, or absent (command, time).

    Attributes
    ----------
    motor, load, command, time : str or None
    rate : float or None
        Hz, of a log without times.
    motor_unit, load_unit, time_unit : str or None
        Where the header does not say them.
    """

    motor: str | None = None
    load: str | None = None
    command: str | None = None
    time: str | None = None
    rate: float | None = None
    motor_unit: str | None = None
    load_unit: str | None = None
    time_unit: str | None = None


@dataclass(frozen=True, eq=False)
class RecordedLog:
    """A recording and what was found while it was read.

    Attributes
    ----------
    recording : EncoderRecording
    columns : mapping
        Name of each part's column.
    samples : int
        Read from the file.
    found : mapping
        Number of samples by defect, in words.
    """

    recording: EncoderRecording
    columns: Mapping[str, str]
    samples: int
    found: Mapping[str, int]


def read_recording(path: Path, wanted: RecordingColumns, progress: Callable[[int], object] = int) -> RecordedLog:
    """Read, find the columns and clean; a log of millions of samples is thinned while it is read.

    `progress` is called with the number of samples read so far.

    Raises
    ------
    InvalidInput
        A file that cannot be read, columns that are missing or hold no numbers, neither times nor a rate, or too few
        samples.
    """
    chosen: dict[str, str] = {}

    def choose(names: Sequence[str]) -> Collection[str]:
        chosen.update(_chosen(path, tuple(names), wanted))
        return chosen.values()

    blocks = read_blocks(path, choose)
    first = next(blocks, None)
    if first is None:
        raise InvalidInput(f"log {path}: holds no row of numbers below the names of its columns")
    units = {part: named_unit(name) for part, name in chosen.items()}
    motor_unit, motor_parts = divided_unit(path, known_unit(wanted.motor_unit or units["motor"]) or "motor unit")
    load_unit, load_parts = divided_unit(path, known_unit(wanted.load_unit or units["load"]) or "load unit")
    both = {"motor": motor_unit, "load": load_unit}
    divisors = {"motor": motor_parts, "load": load_parts}
    turns = {part: 2.0 * np.pi / ANGLES[unit] for part, unit in both.items() if unit in ANGLES}
    clock = LogClock(path, wanted.time_unit or units.get("time", ""), wanted.rate)
    gathering, damaged, counts = Gathering(turns), dict[str, str](), dict[str, float]()
    cut = turned = False
    for table in _oldest_first(_tables(path, chosen, clock, chain([first], blocks))):
        damaged, cut, turned = {**table.damaged, **damaged}, table.cut, table.turned
        for begin in range(0, len(table.time), _BLOCK):
            block = ((name, values[begin : begin + _BLOCK]) for name, values in table.channels.items())
            part = {name: values / divisors.get(name, 1.0) for name, values in block}
            # Thinned samples lie further apart: counts are those of the first block.
            counts = counts or {name: resolution(values[np.isfinite(values)]) for name, values in part.items()}
            try:
                gathering.add(table.time[begin : begin + _BLOCK], part)
            except InvalidInput as error:
                raise InvalidInput(f"log {path}: {error}") from None
            progress(gathering.samples)
    clean = gathering.cleaned()
    check_one_log(path, clean, clock)
    check_left(path, clean, gathering.samples, damaged)
    thinned = THINNED in clean.found
    recording = EncoderRecording(
        time=clean.time,
        motor=clean.channels["motor"],
        load=clean.channels["load"],
        command=clean.channels.get("command"),
        motor_unit=motor_unit,
        load_unit=load_unit,
        source=f"log {path}",
        motor_count=counts["motor"] if thinned else None,
        load_count=counts["load"] if thinned else None,
        alone=clean.alone,
    )
    others = {CUT: int(cut), TURNED: gathering.samples if turned else 0}
    found = {**clean.found, **clock.found, **{defect: count for defect, count in others.items() if count}}
    return RecordedLog(recording, chosen, gathering.samples, found)


class _Table(NamedTuple):
    """A part of a log: (n,) times in s and channels, text in place of numbers, and if its last line has no end."""

    time: Array
    channels: Mapping[str, Array]
    damaged: Mapping[str, str]
    cut: bool
    turned: bool = False


def _tables(path: Path, chosen: Mapping[str, str], clock: LogClock, blocks: Iterator[LogColumns]) -> Iterator[_Table]:
    for columns in blocks:
        arrays = _arrays(path, chosen, columns)
        time = clock.seconds(arrays.pop("time", None), len(arrays["motor"]))
        yield _Table(time, arrays, columns.damaged, columns.ends_within_line)


def _oldest_first(tables: Iterator[_Table]) -> Iterator[_Table]:
    """The tables as they are, or all of them turned round where the newest sample comes first."""
    first = next(tables)
    if not is_newest_first(first.time):
        yield first
        yield from tables
        return
    every = [first, *tables]
    channels = {name: np.concatenate([each.channels[name] for each in every])[::-1] for name in first.channels}
    damaged = {name: text for each in reversed(every) for name, text in each.damaged.items()}
    yield _Table(np.concatenate([each.time for each in every])[::-1], channels, damaged, every[-1].cut, True)


def is_newest_first(time: Array) -> bool:
    """True where nearly all times fall."""
    steps = np.diff(time[np.isfinite(time)])
    return bool(steps.size and np.mean(steps <= 0.0) > _BACKWARDS and np.any(steps < 0.0))


def _arrays(path: Path, chosen: Mapping[str, str], columns: LogColumns) -> dict[str, Array]:
    """Columns by their parts, of one length."""
    arrays = {part: numbers_of(path, name, columns) for part, name in chosen.items()}
    size = len(arrays["motor"])
    for part, values in arrays.items():
        if len(values) != size:
            raise InvalidInput(
                f"log {path}: column {chosen[part]!r} has {len(values)} values and {chosen['motor']!r} has {size}: "
                "they must be of one table"
            )
    return arrays


def check_one_log(path: Path, clean: Cleaned, clock: LogClock) -> None:
    """Refuse a log whose times begin anew and leave too many samples out of order.

    Raises
    ------
    InvalidInput
    """
    if clean.found.get(OUT_OF_ORDER, 0) > _JOINED * clock.samples and clock.set_back is not None:
        raise InvalidInput(f"log {path}: {clock.set_back}: two logs in one file, or two machines; give each by itself")


def check_left(path: Path, clean: Cleaned, size: int, damaged: Mapping[str, str], least: int = _LEAST) -> None:
    """Refuse a log of `size` samples of which too few can be used, with the reasons.

    Raises
    ------
    InvalidInput
    """
    left = clean.time.size
    if size == 0:
        raise InvalidInput(f"log {path}: holds no row of numbers below the names of its columns")
    if left == 1 and clean.found.get(SAME_TIME, 0) > _LEFT * size:
        raise InvalidInput(f"log {path}: its {size} samples have one time stamp: give --rate in Hz")
    whole = size - sum(clean.found.get(defect, 0) for defect in (THINNED, PARTED, REPEATED, BETWEEN))
    if left >= max(least, _LEFT * whole):
        return
    what = "; ".join(f"{defect}: {count}" for defect, count in clean.found.items()) or "the log is short"
    first = next(iter(damaged.items()), None)
    where = f"; column {first[0]!r}, {first[1]}" if first else ""
    raise InvalidInput(
        f"log {path}: {left} of {size} samples can be used, of at least {least} and {100.0 * _LEFT:.0f} % of all "
        f"({what}{where})"
    )


def _chosen(path: Path, names: Sequence[str], wanted: RecordingColumns) -> dict[str, str]:
    """Name of the column of each part."""
    result: dict[str, str] = {}
    check_rate(path, wanted.time, wanted.time_unit, wanted.rate)
    for part in ("time", "motor", "load", "command"):
        given = getattr(wanted, part)
        name = given_column(path, part, given, names) if given is not None else guessed_column(_GUESSES[part], names)
        if part == "time" and wanted.rate is not None:
            continue
        if name is not None:
            result[part] = name
        elif part in ("motor", "load"):
            raise InvalidInput(
                f"log {path}: no column is named like the {part}'s position; give --{part} COLUMN, one of "
                f"{', '.join(names) or 'none'}"
            )
    if "time" not in result and wanted.rate is None:
        raise InvalidInput(
            f"log {path}: no column is named like a time; give --time COLUMN, one of {', '.join(names)}, or --rate in "
            "Hz above 0"
        )
    if result["motor"] == result["load"]:
        raise InvalidInput(f"log {path}: --motor and --load are both {result['motor']!r}: give two columns")
    return result


def numbers_of(path: Path, name: str, columns: LogColumns) -> Array:
    """A column's numbers.

    Raises
    ------
    InvalidInput
        It holds none.
    """
    values = columns.values[name]
    kind = getattr(getattr(values, "dtype", None), "kind", "")
    if name == _INDEX and kind in "iu":
        raise InvalidInput(f"log {path}: the table's index counts rows: give --time COLUMN, or --rate in Hz")
    if kind in "mM" and kind:
        values = values.astype("datetime64[ns]" if kind == "M" else "timedelta64[ns]").astype(np.int64) * 1e-9
    try:
        if np.iscomplexobj(values):
            raise TypeError
        return np.asarray(values, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise InvalidInput(f"log {path}: column {name!r} must hold numbers") from None
