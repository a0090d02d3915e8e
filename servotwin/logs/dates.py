"""Dates and times of day in the cells of tables, as controls, historians and spreadsheets write them."""

from __future__ import annotations

import re

import numpy as np

_CLOCK = r"(?P<clock>\d{1,2}:\d\d(:\d\d([.,:]\d+)?)?)\s*(?P<half>[AaPp][Mm])?"
_ZONE = r"(Z|(?P<sign>[+-])(?P<ahead>\d\d):?(?P<minutes>\d\d))?"
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_FORMS = tuple(
    re.compile(form + "$")
    for form in (
        rf"(?P<year>\d{{4}})-(?P<month>\d\d)-(?P<day>\d\d)[T ]{_CLOCK} ?{_ZONE}",
        rf"(?P<year>\d{{4}})/(?P<month>\d\d?)/(?P<day>\d\d?) +{_CLOCK}",
        rf"(?P<day>\d\d?)\.(?P<month>\d\d?)\.(?P<year>\d{{4}}),? +{_CLOCK}",
        rf"(?P<month>\d\d?)/(?P<day>\d\d?)/(?P<year>\d{{4}}),? +{_CLOCK}",
        rf"(?P<day>\d\d?)/(?P<month>\d\d?)/(?P<year>\d{{4}}),? +{_CLOCK}",
        rf"(?P<day>\d\d?)[- ](?P<word>[A-Za-z]{{3}})[- ](?P<year>\d{{4}}),? +{_CLOCK}",
        _CLOCK,
        r"(?P<year>\d{4})-(?P<month>\d\d)-(?P<day>\d\d)",
        r"(?P<day>\d\d?)\.(?P<month>\d\d?)\.(?P<year>\d{4})",
        r"(?P<month>\d\d?)/(?P<day>\d\d?)/(?P<year>\d{4})",
    )
)


def time_of(cell: str) -> float | None:
    """Seconds since 1970 of a date, with a time or without; since midnight of a time alone; None for anything else.

    Of 03/04/2026 the month comes first, unless it cannot.
    """
    for form in _FORMS:
        found = form.match(cell)
        if found:
            parts = found.groupdict()
            seconds = _seconds(parts["clock"].replace(",", "."), parts["half"]) if "clock" in parts else 0.0
            day = _day(parts) if "year" in parts else 0.0
            if seconds is not None and day is not None:
                return day + seconds - _ahead(parts)
    return None


def _seconds(clock: str, half: str | None) -> float | None:
    # Some write the thousandths behind a third colon.
    whole, _, thousandths = clock.rpartition(":") if clock.count(":") > 2 else (clock, "", "")
    hour, *others = (float(part) for part in (f"{whole}.{thousandths}" if thousandths else whole).split(":"))
    if half:
        hour = hour % 12.0 + (12.0 if half.lower() == "pm" else 0.0)
    minute, second = others[0], others[1] if len(others) > 1 else 0.0
    return 3600.0 * hour + 60.0 * minute + second if hour < 24.0 and minute < 60.0 and second < 61.0 else None


def _day(parts: dict[str, str]) -> float | None:
    """Seconds from 1970 to the beginning of a day."""
    try:
        month = _MONTHS.index(parts["word"].lower()) + 1 if "word" in parts else int(parts["month"])
        day = np.datetime64(f"{parts['year']}-{month:02d}-{int(parts['day']):02d}", "s")
    except ValueError:
        return None
    return float(day.astype(np.int64))


def _ahead(parts: dict[str, str]) -> float:
    """Seconds by which a zone's clock is ahead of UTC; 0 where none is said."""
    if not parts.get("sign"):
        return 0.0
    ahead = 3600.0 * float(parts["ahead"]) + 60.0 * float(parts["minutes"])
    return -ahead if parts["sign"] == "-" else ahead
