"""Dates of logs: as given with the command, stamped in the log, or of its file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.logs.recordings import RecordedLog

DATED = 3e8  # s since 1970: smaller times are no dates
_DAY = re.compile(r"\d{4}-\d\d-\d\d$")


class LogDate(NamedTuple):
    """Date of a log, s since 1970, and where it is from: "given", "stamped" in the log, or that of its "file"."""

    time: float
    origin: str


def dates_of(text: str | None, logs: int) -> list[float | None]:
    """Dates with commas between them as seconds since 1970, one for each log; None: of the log or its file.

    Raises
    ------
    InvalidInput
        No date, or another number of them than of logs.
    """
    if text is None:
        return [None] * logs
    days = text.split(",")
    try:
        if not all(_DAY.match(day.strip()) for day in days):
            raise ValueError
        found = [float(np.datetime64(day.strip(), "s").astype(np.int64)) for day in days]
    except ValueError:
        raise InvalidInput(f"--dates {text!r}: give dates such as 2026-03-01, with commas between them") from None
    if len(found) != logs:
        raise InvalidInput(f"--dates {text!r}: has {len(found)} dates for {logs} logs; give one for each")
    return list(found)


def date_of(log: RecordedLog, given: float | None) -> LogDate:
    """The date of a log: the given one (s since 1970), if there is one."""
    if given is not None:
        return LogDate(given, "given")
    first = float(log.recording.time[0])
    if first > DATED:
        return LogDate(first, "stamped")
    return LogDate(Path(log.recording.source.removeprefix("log ")).stat().st_mtime, "file")


def iso(date: float) -> str:
    """A date (s since 1970) as text."""
    return str(np.datetime64(round(date), "s"))
