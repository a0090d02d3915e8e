"""Replay of a recorded log in place of a machine, in the role supervise.

The log is a CSV as `servotwin simulate` writes it, read line by line: time_s, and of reference, position, motor's angle
and command each one of the columns of `SIGNAL_COLUMNS`, converted to SI. `servotwin convert LOG LOG.csv` converts logs
of other kinds; it needs numpy. For an edge whose motor has no encoder the angle may be absent, and is NaN.
The replay accepts and records parameters, which change nothing: the samples are those of the log.
"""

from __future__ import annotations

import os
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
from math import isfinite, nan
from pathlib import Path
from typing import NamedTuple, TextIO

from servotwin.config.named_file import check_named
from servotwin.config.own_units import OwnUnits
from servotwin.config.units import SIGNAL_COLUMNS, Unit, unit_of
from servotwin.edge.drive import Block, DriveLost
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput

COLUMNS = (("time_s",), *(SIGNAL_COLUMNS[name] for name in ("reference", "theta_m", "position", "voltage")))
"""Columns that are read, by their possible names; the first one that the file has counts."""

_MOTOR = 2
"""Place of the motor's angle among them."""

_JITTER = 0.05
"""Largest distance of a rounded time stamp from a uniform grid, in sample intervals."""

_MOST_WRITTEN = 1000
"""Largest number of written parameters that are stored."""


class Written(NamedTuple):
    """Parameters written to a replay, and the sample from which they would have been in force."""

    number: int
    parameters: Parameters


class Extent(NamedTuple):
    """Extent of a log: number of samples, and their rate (Hz)."""

    samples: int
    rate: float


class Replay:
    """`edge.drive.SupervisedDrive` of a log.

    Parameters
    ----------
    path : path
        NAME.csv.
    speed : float
        Seconds of the log per second; 0: as fast as it is read.
    loop : bool
        Begin again at the end. Between two rounds one sample number is left out, so that the reader sees the break.
    block_s : float
        Length of a block where the reader gives none, s of the log.
    motor_encoder : bool
        False: the log may lack the motor's angle, which is then NaN.
    clock, sleep : callable
        Returns monotonic seconds; waits for a number of seconds.
    """

    can_move = False
    lag = 0.0

    def __init__(
        self,
        path: str | os.PathLike[str],
        speed: float = 1.0,
        loop: bool = False,
        block_s: float = 0.05,
        motor_encoder: bool = True,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._path, self._speed, self._loop, self._block_s = Path(path), speed, loop, block_s
        self._motor_encoder, self._clock, self._sleep = motor_encoder, clock, sleep
        self._extent = Extent(0, 0.0)
        self._file: TextIO | None = None
        self._rows: Iterator[tuple[float, ...]] = iter(())
        self._number = self._version = 0
        self.written: deque[Written] = deque(maxlen=_MOST_WRITTEN)

    @property
    def rate(self) -> float:
        """Samples per second of the log, Hz."""
        return self._extent.rate

    @property
    def patient(self) -> bool:
        """True where the log is read as fast as possible."""
        return self._speed == 0.0

    @property
    def machine(self) -> str:
        """Name of the log."""
        return self._path.name

    def connect(self) -> None:
        """Check the whole log, then begin with its first sample.

        Raises
        ------
        InvalidInput
            The log is missing, has a damaged line, lacks a column, or its times are not uniform.
        """
        self.close()
        self._extent = extent(self._path, self._motor_encoder)
        self._begin()
        self._zero = self._clock() - (self._number / (self.rate * self._speed) if self._speed else 0.0)

    def read(self, most: int = 0) -> Block | None:
        """Return the next samples, when the last of them is due; None: the log has ended."""
        if self._file is None:
            raise DriveLost(f"log {self._path}: not connected")
        rows = list(islice(self._rows, most or max(1, round(self._block_s * self.rate))))
        if not rows and self._loop:
            self._number += 1
            self._begin()
            return self.read(most)
        if not rows:
            return None
        first, self._number = self._number, self._number + len(rows)
        if self._speed:
            self._sleep(max(0.0, self._zero + self._number / (self.rate * self._speed) - self._clock()))
        return Block(first, self._version, *(array("d", signal) for signal in list(zip(*rows, strict=True))[1:]))

    def write(self, parameters: Parameters) -> None:
        """Record the parameters; only the version of the samples changes from here on."""
        self._version = parameters.version
        self.written.append(Written(self._number, parameters))

    def move(self, _offset: float) -> None:
        """Do nothing: a recorded reference cannot be moved."""

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _begin(self) -> None:
        self.close()
        self._file = opened(self._path)
        self._rows = rows(self._path, self._file, self._motor_encoder)


def opened(path: Path) -> TextIO:
    """Open a log.

    Raises
    ------
    InvalidInput
        The file cannot be read, or is not a .csv.
    """
    if path.suffix != ".csv":
        made = f"servotwin convert {path} {path.with_suffix('.csv')}"
        raise InvalidInput(f"log {path}: the suffix {path.suffix!r} is not allowed; give a .csv, for example by {made}")
    check_named(path, "log ")
    try:
        return path.open(encoding="utf-8-sig")
    except OSError as error:
        raise InvalidInput(f"log {path}: cannot be read ({error.strerror})") from None


def check_begin(path: Path, motor_encoder: bool = True, units: OwnUnits | None = None) -> None:
    """Check that a log has its columns, in an edge's units, and a first sample, without reading it whole.

    Raises
    ------
    InvalidInput
        It has none, or in other units.
    """
    with opened(path) as file:
        if next(rows(path, file, motor_encoder), None) is None:
            raise InvalidInput(f"log {path}: has no samples")
    if units is not None:
        with opened(path) as file:
            _check_units(path, _head(file)[1], units)


def _check_units(path: Path, names: list[str], units: OwnUnits) -> None:
    """Refuse a log whose command or position is in another unit than those of the edge."""
    _, _, _, positions, commands = COLUMNS
    for allowed, key, unit in ((positions, "position_unit", units.position), (commands, "command_unit", units.command)):
        name = next(name for name in allowed if name in names)
        if unit_of(name).si != unit:
            raise InvalidInput(
                f'log {path}: column {name} is in {unit_of(name).si}, and {key} = "{unit}" in the file of the edge: '
                "give the log of such a machine, or the key as the log has it"
            )


def extent(path: Path, motor_encoder: bool = True) -> Extent:
    """Check every sample of a log, and return their number and rate."""
    with opened(path) as file:
        times = array("d", (row[0] for row in rows(path, file, motor_encoder)))
    if len(times) < 2:
        raise InvalidInput(f"log {path}: has {len(times)} samples; at least 2 are needed")
    interval = (times[-1] - times[0]) / (len(times) - 1)
    for index, at in enumerate(times):
        if not abs(at - (times[0] + index * interval)) < _JITTER * interval:
            raise InvalidInput(f"log {path}: time_s = {at!r} s at sample {index}: must be increasing, uniformly spaced")
    return Extent(len(times), float(f"{1.0 / interval:.9g}"))


def rows(path: Path, file: TextIO, motor_encoder: bool = True) -> Iterator[tuple[float, ...]]:
    """Yield (time, reference, theta_m, position, command) of each line: s, m or rad, rad, m or rad, the drive's unit.

    Without an encoder of the motor its angle is NaN.

    Raises
    ------
    InvalidInput
        A column is missing, or a line does not hold finite numbers.
    """
    try:
        number, names = _head(file)
        columns = _columns(path, names, motor_encoder)
        for number, line in enumerate(file, number + 1):  # noqa: B020
            yield _numbers(path, number, line.split(","), columns)
    except UnicodeDecodeError as error:
        raise InvalidInput(f"log {path}: is not a text file (byte {error.start} is not UTF-8)") from None


def _head(file: TextIO) -> tuple[int, list[str]]:
    """Number of the line with the columns' names, and the names."""
    line, number = file.readline(), 1
    if line.startswith("#"):
        line, number = file.readline(), 2
    return number, [name.strip() for name in line.split(",")]


class _Column(NamedTuple):
    """Place of a column in a line, and the SI value of one of its units."""

    place: int
    unit: Unit


def _columns(path: Path, names: list[str], motor_encoder: bool) -> list[_Column | None]:
    """The columns that are read; None: the motor's angle, where it has no encoder."""
    chosen: list[str | None] = []
    for place, allowed in enumerate(COLUMNS):
        if place == _MOTOR and not motor_encoder:
            chosen.append(None)
            continue
        present = next((name for name in allowed if name in names), None)
        if present is None:
            column = f"column {' or '.join(allowed)} is missing; it has {', '.join(names):.200}"
            other = "; of a motor without encoder the edge's file says motor_encoder = false" if place == _MOTOR else ""
            raise InvalidInput(f"log {path}: {column}{other}")
        chosen.append(present)
    reference, position = chosen[1], chosen[3]
    assert reference is not None
    assert position is not None
    if unit_of(reference).si != unit_of(position).si:
        raise InvalidInput(f"log {path}: columns {position} and {reference}: must both be lengths or both be angles")
    return [None if name is None else _Column(names.index(name), unit_of(name)) for name in chosen]


def _numbers(path: Path, number: int, cells: list[str], columns: list[_Column | None]) -> tuple[float, ...]:
    try:
        values = tuple(nan if at is None else at.unit.to_si(float(cells[at.place])) for at in columns)
    except (ValueError, IndexError):
        values = ()
    if not values or not all(at is None or isfinite(value) for value, at in zip(values, columns, strict=True)):
        raise InvalidInput(f"log {path}: line {number} must hold finite numbers, {len(cells)} cells were found")
    return values
