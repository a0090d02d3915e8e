"""Report of one machine as one HTML file, for people without access to the twin."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from typing import Any

from servotwin.dashboard.fleet import FleetRow, Interval
from servotwin.dashboard.machine_facts import MachineFacts
from servotwin.messages import Reason
from servotwin.report.page import page
from servotwin.report.time_chart import BLUE, GREEN, ORANGE, RED, ChartLine, ChartMark, TimeChart

DEG = 180.0 / math.pi
_HOUR, _DAY, _YEAR = 3600.0, 86400.0, 365.25 * 86400.0
_STATUS = {"ok": "estimate accepted", "nothing moved": "unchanged", "": "no estimate yet"}
Trace = dict[str, Any]
"""A window with what followed, in the form of the API."""


def machine_report(row: FleetRow, series: dict[str, Any], traces: Sequence[Trace], now: float) -> str:
    """Compose the page.

    Parameters
    ----------
    row : FleetRow
    series : dict
        As `machine_series` reads it.
    traces : sequence of dict
        Windows that led to updates.
    now : float
        s since the epoch.
    """
    machine: MachineFacts = series["machine"]
    unit, factor = _UNITS[machine.travel_unit]
    count = len(series["windows"]["received"])
    return page(
        "machine.html",
        f"{row.servo} – servotwin",
        servo=row.servo,
        known=stamp(now),
        facts=list(_facts(row)),
        alarms=[(stamp(each.time), each.sentence) for each in row.alarms],
        windows=count,
        gap=_gap_chart(series) if count else b"",
        error=_error_chart(series, unit, factor) if count else b"",
        unit=unit,
        updates=_updates(traces, factor),
    )


def stamp(time: float | None) -> str:
    """A time in ISO form, UTC, to the minute."""
    return "never" if time is None else datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M")


def _facts(row: FleetRow) -> Iterator[tuple[str, str, str]]:
    travel = ""
    if row.gap is not None and row.travel is not None:
        moved = row.gap * row.travel
        travel = (
            f", {_brief(moved * DEG)} deg at the load"
            if row.travel_unit == "rad"
            else f", {_brief(moved * 1e6)} µm of travel"
        )
    yield (
        "Gap",
        f"{_with_interval(row.gap, row.interval, DEG)} deg (95 %)",
        _STATUS.get(row.status, row.status) + travel,
    )
    rate, name = _rate(row)
    yield "Wear", f"{rate} {name}".strip(), "of machine time, 95 %"
    limit = "gap_limit_deg is not set" if row.gap_limit is None else f"limit {_brief(row.gap_limit * DEG)} deg"
    yield "Time to the gap limit", _until(row), limit
    sent = "none was sent" if row.version_sent is None else f"{row.version_sent} was sent last"
    yield "Version in force", "–" if row.version_in_force is None else str(row.version_in_force), sent
    window = row.last_window
    yield "Last window", stamp(None if window is None else window.received), f"{row.windows} stored"
    state = {True: "connected", False: "not connected", None: "cannot be known here"}[row.connected]
    yield "Link", state, f"last message {stamp(row.last_message)}"


def _gap_chart(series: dict[str, Any]) -> bytes:
    windows, limit = series["windows"], series["machine"].gap_limit
    times, gap = windows["received"], _scaled(windows["gap"], DEG)
    lines = [ChartLine("estimate", BLUE, gap, dots=True), ChartLine("trend", GREEN, _scaled(windows["trend"], DEG))]
    top = max((value for value in gap if value is not None), default=0.0)
    if limit is not None and limit * DEG < 3.0 * top:
        lines.append(ChartLine("limit", RED, [limit * DEG] * len(times), dash="6 4"))
    band = _scaled(windows["low"], DEG), _scaled(windows["high"], DEG)
    return TimeChart("Gap (deg)", times, lines, band, _marks(series)).svg()


def _error_chart(series: dict[str, Any], unit: str, factor: float) -> bytes:
    windows = series["windows"]
    errors = ChartLine("error at the end", BLUE, _scaled(windows["tail"], factor), dots=True)
    return TimeChart(f"Error at the end ({unit})", windows["received"], (errors,), marks=_marks(series)).svg()


def _marks(series: dict[str, Any]) -> list[ChartMark]:
    first = series["windows"]["received"][0]
    marks = [
        ChartMark(each["answered"], f"v{each['version']}", ORANGE if each["applied"] else RED)
        for each in series["versions"]
        if each["applied"] is not None
    ]
    marks += [ChartMark(each["time"], "fallback", RED) for each in series["fallbacks"]]
    return [mark for mark in marks if mark.time >= first]


def _updates(traces: Iterable[Trace], factor: float) -> list[tuple[str, ...]]:
    steps = [(trace, step) for trace in traces for step in trace["steps"]]
    steps.sort(key=lambda pair: -pair[1]["update"]["version"])
    return [_update(trace, step, factor) for trace, step in steps]


_UNITS = {"rad": ("deg", DEG), "m": ("mm", 1e3), "": ("m or rad", 1.0)}
_REFUSED, _MET = "refused it", "did not apply it"


def _update(trace: Trace, step: Trace, factor: float) -> tuple[str, ...]:
    update = step["update"]
    body = update["body"] or {}
    verification, setting = body.get("verification"), body.get("setting") or {}
    tolerance = setting.get("tolerance") or 0.0
    return (
        str(update["version"]),
        stamp(update["created"]),
        str(trace["window"]["sequence"]),
        _with_interval(body.get("gap"), body.get("interval"), DEG),
        _brief(tolerance * factor) if tolerance else "none",
        f"{verification['members']} simulated machines" if verification else "not simulated",
        _answer(step),
        "" if _answer(step).startswith((_REFUSED, _MET)) else _effect(step["effect"], factor),
    )


def _answer(step: Trace) -> str:
    answers = {answer["kind"]: answer for answer in step["answers"]}
    if "fallback" in answers:
        return f"left it for its fallback set: {answers['fallback']['status']}"
    if "receipt" not in answers:
        return "has not answered yet"
    receipt = answers["receipt"]
    body = receipt["body"] or {}
    if receipt["status"] == Reason.FELL_BACK:
        return f"{_MET}: {receipt['status']}, as version {body.get('parameter_version')}"
    if body.get("applied"):
        return "applied it"
    return ": ".join(filter(None, (_REFUSED, receipt["status"], body.get("detail"))))


def _effect(effect: Trace | None, factor: float) -> str:
    if effect is None:
        return "no window under it yet"
    ends = (effect["before"], effect["after"])
    return " → ".join("?" if each is None or each["tail"] is None else _brief(each["tail"] * factor) for each in ends)


def _rate(row: FleetRow) -> tuple[str, str]:
    if row.rate is None:
        return "no trend yet", ""
    size = abs(row.rate) * DEG
    per, name = next(
        ((per, name) for per, name in ((_HOUR, "deg/h"), (_DAY, "deg/day")) if size * per >= 0.1), (_YEAR, "deg/year")
    )
    return _with_interval(row.rate, row.rate_interval, DEG * per), name


def _until(row: FleetRow) -> str:
    if row.gap_limit is None or row.until_limit is None:
        return "–" if row.rate is None or row.gap_limit is None else "not growing"
    if row.until_limit == 0.0:
        return "reached"
    early, late = row.until_limit_interval or (row.until_limit, None)
    latest = "" if late is None else f" to {_duration(late)}"
    return f"{_duration(row.until_limit)} ({_duration(early)}{latest or ' at the earliest'})"


def _duration(seconds: float) -> str:
    for size, name in ((_YEAR, "years"), (_DAY, "days"), (_HOUR, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.{0 if seconds >= 10.0 * size else 1}f} {name}"
    return f"{seconds:.0f} s"


def _with_interval(value: float | None, interval: Interval | Sequence[float | None] | None, factor: float) -> str:
    """The value with half its interval, in as many digits as that deserves."""
    if value is None:
        return "–"
    low, high = interval or (None, None)
    if low is None:
        return _brief(value * factor)
    if high is None:
        return f"≥ {_brief(low * factor)}"
    half = (high - low) / 2.0 * factor
    if not half > 0.0:
        return _brief(value * factor)
    decimals = min(6, max(0, 1 - math.floor(math.log10(half))))
    return f"{value * factor:.{decimals}f} ± {half:.{decimals}f}"


def _brief(value: float) -> str:
    return f"{value:.3g}"


def _scaled(values: Iterable[float | None], factor: float) -> list[float | None]:
    return [None if value is None else value * factor for value in values]
