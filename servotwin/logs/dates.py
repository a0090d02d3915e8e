"""Dates and times of day in the cells of tables, as controls, historians and spreadsheets write them."""

from __future__ import annotations

import re

import numpy as np

_CLOCK = r"(?P<clock>\d{1,2}:\d\d(:\d\d([.,]\d+)?)?)\s*(?P<half>[AaPp][Mm])?"
_FORMS = tuple(
    re.compile(form + "$")
    for form in (
        rf"(?P<year>\d{{4}})-(?P<month>\d\d)-(?P<day>\d\d)[T ]{_CLOCK}Z?",
        rf"(?P<year>\d{{4}})/(?P<month>\d\d?)/(?P<day>\d\d?) +{_CLOCK}",
        rf"(?P<day>\d\d?)\.(?P<month>\d\d?)\.(?P<year>\d{{4}}),? +{_CLOCK}",
        rf"(?P<month>\d\d?)/(?P<day>\d\d?)/(?P<year>\d{{4}}),? +{_CLOCK}",
        rf"(?P<day>\d\d?)/(?P<month>\d\d?)/(?P<year>\d{{4}}),? +{_CLOCK}",
        _CLOCK,
    )
)


def time_of(cell: str) -> float | None:
    """Seconds since 1970 of a date with a time, seconds since midnight of a time alone; None for anything else.

    Of 03/04/2026 the month comes first, unless it cannot.
    """
    for form in _FORMS:
        found = form.match(cell)
        if found:
            parts = found.groupdict()
            seconds = _seconds(parts["clock"].replace(",", "."), parts["half"])
            day = _day(parts) if "year" in parts else 0.0
            if seconds is not None and day is not None:
                return day + seconds
    return None


def _seconds(clock: str, half: str | None) -> float | None:
    hour, *others = (float(part) for part in clock.split(":"))
    if half:
        hour = hour % 12.0 + (12.0 if half.lower() == "pm" else 0.0)
    minute, second = others[0], others[1] if len(others) > 1 else 0.0
    return 3600.0 * hour + 60.0 * minute + second if hour < 24.0 and minute < 60.0 and second < 61.0 else None


def _day(parts: dict[str, str]) -> float | None:
    """Seconds from 1970 to the beginning of a day."""
    try:
        day = np.datetime64(f"{parts['year']}-{int(parts['month']):02d}-{int(parts['day']):02d}", "s")
    except ValueError:
        return None
    return float(day.astype(np.int64))
