"""Times of a log in seconds: their unit, where days or an epoch count, midnight, and an hour that came twice."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.names import known_unit
from servotwin.plant.signals import Array

MIDNIGHTS = "midnights, at which the time of day began anew"
HOURS_BACK = "hours that the clock was set back, as it is in autumn"
WHOLE = "times in whole numbers of no stated unit, read as seconds; say --time-unit ms where they are milliseconds"
_DAY, _HOUR = 86400.0, 3600.0  # s
_SECONDS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "microseconds"), 1e-6),
    "ns": 1e-9,
    **dict.fromkeys(("min", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hours"), _HOUR),
    **dict.fromkeys(("d", "days"), _DAY),
}
_SHOWN = ("s", "ms", "us", "ns", "min", "h", "d")
_SET_BACK = 100.0  # usual intervals: a smaller step back is disorder
_OTHER_RATE = 0.02  # relative: more than a crystal's error, or a rate that is stated in round numbers
_CONTINUES = 5.0  # usual intervals, within which a clock that was set back goes on


class SetBack(NamedTuple):
    """Sample, counted from 1, at which a log's times go back, and by how much, s."""

    sample: int
    by: float

    def __str__(self) -> str:
        return f"at sample {self.sample} its times go back by {self.by:.4g} s"


class _Epoch(NamedTuple):
    """Times that count from a known date: their range over the dates 1990 to 2100, their unit in s, and the date."""

    low: float
    high: float
    unit: float
    begin: float  # s since 1970
    name: str


_BEGIN, _END = 6.3e8, 4.2e9  # 1990 and 2100, s since 1970
_EXCEL, _MATLAB, _WINDOWS = -25569.0 * _DAY, -719529.0 * _DAY, -11644473600.0


def _epoch(unit: float, begin: float, name: str) -> _Epoch:
    return _Epoch((_BEGIN - begin) / unit, (_END - begin) / unit, unit, begin, name)


_EPOCHS = (
    _epoch(1e-3, 0.0, "ms since 1970"),
    _epoch(1e-6, 0.0, "us since 1970"),
    _epoch(1e-9, 0.0, "ns since 1970"),
    _epoch(1e-7, _WINDOWS, "100 ns since 1601"),
    _epoch(_DAY, _EXCEL, "days since 1900, as spreadsheets count them"),
    _epoch(_DAY, _MATLAB, "days since the year 0, as MATLAB counts them"),
)


def check_rate(path: Path, time: str | None, unit: str | None, rate: float | None) -> None:
    """Refuse a sample rate (Hz) beside a column of times or its unit: it replaces the times."""
    for option, value in (("--time", time), ("--time-unit", unit)):
        if rate is not None and value is not None:
            raise InvalidInput(f"log {path}: {option} {value!r} and --rate {rate:g}: give one of the two")


class LogClock:
    """Times of one log, block after block.

    Parameters
    ----------
    path : Path
        For messages.
    unit : str
        Of the times, as the header or the user says; empty: seconds, or what their size shows.
    rate : float or None
        Hz, of a log without times.

    Raises
    ------
    InvalidInput
        An unknown unit, or a rate that is not positive.
    """

    def __init__(self, path: Path, unit: str, rate: float | None) -> None:
        unit = known_unit(unit)
        if rate is None and unit and unit.lower() not in _SECONDS:
            raise InvalidInput(f"log {path}: times in {unit!r}: allowed are {', '.join(_SHOWN)}")
        if rate is not None and not (np.isfinite(rate) and rate > 0.0):
            raise InvalidInput(f"log {path}: --rate {rate:g}: must be above 0 Hz and finite")
        self._path, self._unit, self._rate = path, unit.lower(), rate
        self._epoch: _Epoch | None = None
        self._last = np.nan  # as the log has it, s
        self._newest: Array | None = None  # the last time, s
        self._shift = 0.0  # s, by which midnights and hours moved it
        self.samples = 0
        self.found: dict[str, int] = {}
        self.set_back: SetBack | None = None
        """The largest step back of its times, beyond some samples."""

    def seconds(self, times: Array | None, size: int) -> Array:
        """Times of the next block, (size,) s; NaN where the log has none.

        Raises
        ------
        InvalidInput
            The log has neither times nor a rate.
        """
        before, self.samples = self.samples, self.samples + size
        if self._rate is not None:
            if times is not None:
                self._note_other_rate(times, self._rate)
            return np.arange(before, before + size) / self._rate
        if times is None:
            raise InvalidInput(
                f"log {self._path}: no column is named like a time; give --time COLUMN, or --rate in Hz above 0"
            )
        if not self._unit and before == 0:
            self._epoch = _seen_epoch(times)
        if self._epoch is not None:
            name = f"samples with times in {self._epoch.name}"
            self.found[name] = self.found.get(name, 0) + size
            result = times * self._epoch.unit + self._epoch.begin
        else:
            if not self._unit:
                self._note_whole(times)
            result = self._continued(times * _SECONDS.get(self._unit, 1.0))
        self._note_set_back(result, before)
        return result

    def _note_other_rate(self, times: Array, rate: float) -> None:
        """Note where the log's own times, of a stated unit, say another rate than the one that replaces them."""
        steps = np.diff(times[np.isfinite(times)]) * _SECONDS.get(self._unit, 0.0)
        usual = float(np.median(steps)) if steps.size else 0.0
        if usual > 0.0 and abs(rate * usual - 1.0) > _OTHER_RATE:
            name = f"samples timed by --rate {rate:g} Hz, though the log's own times say {1.0 / usual:.4g} Hz"
            self.found[name] = self.found.get(name, 0) + times.size

    def _note_whole(self, times: Array) -> None:
        """Note what looks like milliseconds, though nothing says so: logs of encoders have fractions of seconds."""
        known = times[np.isfinite(times)]
        if known.size and np.all(known == np.round(known)):
            self._count(WHOLE, known.size)

    def _note_set_back(self, times: Array, before: int) -> None:
        known = np.flatnonzero(np.isfinite(times))
        own = times[known]
        steps = np.diff(own, prepend=own[:1] if self._newest is None else self._newest)
        if not steps.size:
            return
        place, usual = int(np.argmin(steps)), float(np.median(np.abs(steps)))
        least = 0.0 if self.set_back is None else self.set_back.by
        if -steps[place] > max(least, _SET_BACK * usual):
            self.set_back = SetBack(before + int(known[place]) + 1, -float(steps[place]))
        self._newest = own[-1:]

    def _continued(self, times: Array) -> Array:
        """The times with the days and hours that a clock on the wall leaves out."""
        known = np.flatnonzero(np.isfinite(times))
        if not known.size:
            return times
        own = times[known]
        steps = np.diff(own, prepend=own[:1] if np.isnan(self._last) else self._last)
        forward = steps[steps > 0.0]
        usual = float(np.median(forward)) if forward.size else 0.0
        shifts = np.zeros(own.size)
        if own.min() >= 0.0 and own.max() <= _DAY:
            midnights = np.where(np.abs(steps) > 0.5 * _DAY, -np.sign(steps), 0.0)
            self._count(MIDNIGHTS, int(np.sum(np.abs(midnights))))
            shifts += _DAY * midnights
        back = (steps < 0.0) & (np.abs(steps + _HOUR) <= _CONTINUES * usual)
        self._count(HOURS_BACK, int(np.sum(back)))
        shifts += _HOUR * back
        moved = self._shift + np.cumsum(shifts)
        self._last, self._shift = float(own[-1]), float(moved[-1])
        result = times.copy()
        result[known] = own + moved
        return result

    def _count(self, defect: str, count: int) -> None:
        if count:
            self.found[defect] = self.found.get(defect, 0) + count


def _seen_epoch(times: Array) -> _Epoch | None:
    """The epoch that unnamed times count from; None: they are seconds.

    Days are told from seconds by their steps: a log of an encoder has more than one sample a second, and a clock of
    seconds has not a hundred thousand.
    """
    known = times[np.isfinite(times)]
    steps = np.abs(np.diff(known))
    steps = steps[steps > 0.0]
    if not steps.size:
        return None
    middle, usual = float(np.median(known)), float(np.median(steps))
    for each in _EPOCHS:
        if each.low < middle < each.high and (each.unit < 1.0 or usual * _DAY < 1.0):
            return each
    return None
