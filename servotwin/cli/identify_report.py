"""Report of `servotwin identify` with a model: a table of the windows and the trend, or one JSON object."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from servotwin.cli.identify import Identification, IdentifyOptions, identify, stated_limit
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.trend import Trend
from servotwin.estimation.window import Window


def show(options: IdentifyOptions, as_json: bool) -> None:
    """Print tables, or one JSON object, on the standard output."""
    identification = _identified(options)
    if as_json:
        print(json.dumps(as_dict(identification, options), indent=2, allow_nan=False))
        return
    console = Console()
    count = sum(estimate.ok for estimate in identification.estimates)
    console.print(
        f"{options.log}: {len(identification.windows)} windows, {count} OK, model {identification.servo.version}",
        highlight=False,
    )
    console.print(_table(identification), highlight=False)
    for line in (*_remarks(identification), *_trend_lines(identification, options)):
        console.print(line, highlight=False)


def _identified(options: IdentifyOptions) -> Identification:
    """Estimate under a progress bar on the standard error: a window from the motor's side takes up to a minute."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("reading", total=None)

        def report(done: int, total: int) -> None:
            progress.update(bar, description=f"window {done + 1} of {total}", completed=done, total=total)

        return identify(options, report)


def _table(identification: Identification) -> Table:
    table = Table("window, s", "gap, deg", "95 % interval, deg", "status", box=None, pad_edge=False)
    for window, estimate in zip(identification.windows, identification.estimates, strict=True):
        end = window.start + window.duration
        color = "green" if estimate.ok else "yellow"
        table.add_row(f"{window.start:.2f} .. {end:.2f}", *_cells(estimate), f"[{color}]{estimate.status.value}[/]")
        for reason in estimate.reasons:
            table.add_row("", "", "", f"[dim]{reason}[/]")
    return table


def _cells(estimate: GapEstimate) -> tuple[str, str]:
    """Gap and interval, or a bound; without either the prior is not shown as a result."""
    if estimate.ok:
        low, high = map(math.degrees, estimate.interval)
        return f"{math.degrees(estimate.gap):.3f}", f"{low:.3f} .. {high:.3f}"
    bounded = estimate.status is GapStatus.LOWER_BOUND
    return (f"> {math.degrees(estimate.gap):.3f}" if bounded else "-", "-")


def _remarks(identification: Identification) -> list[str]:
    pairs = zip(identification.windows, identification.remarks, strict=True)
    return [f"at {window.start:.2f} s: {remark}" for window, remarks in pairs for remark in remarks]


def _trend_lines(identification: Identification, options: IdentifyOptions) -> list[str]:
    trend = identification.trend
    if trend is None:
        words = "no window shows the gap, so there is no trend"
        reasons = [reason for estimate in identification.estimates for reason in estimate.reasons]
        if any("one flank" in reason or "needed both ways" in reason for reason in reasons):
            words += "; a window with two steps, to and fro, shows both flanks: give its length with --window"
        return [words]
    low, high = map(math.degrees, trend.gap_interval)
    slow, fast = map(math.degrees, trend.rate_interval)
    lines = [f"gap at {trend.time:.2f} s: {math.degrees(trend.gap):.3f} deg (95 %: {low:.3f} .. {high:.3f})"]
    if trend.updates > 1:
        lines.append(f"wear: {math.degrees(trend.rate):.3g} deg/s (95 %: {slow:.3g} .. {fast:.3g})")
    if identification.until_limit is not None:
        early, late = identification.until_limit.interval
        median = (
            f"{identification.until_limit.median:.4g} s"
            if math.isfinite(identification.until_limit.median)
            else "perhaps never"
        )
        form, limit = stated_limit(options, identification.servo)
        lines.append(f"time until {limit:g} {form.unit}: {median} (median; 95 %: {early:.4g} .. {late:.4g} s)")
    return lines


def as_dict(identification: Identification, options: IdentifyOptions) -> dict[str, Any]:
    """Make the JSON object: angles in deg, times in s, null where there is no number."""
    trend, until = identification.trend, identification.until_limit
    rows = zip(identification.windows, identification.estimates, identification.remarks, strict=True)
    return {
        "log": str(options.log),
        "model": identification.servo.version,
        "method": options.method,
        "windows": [_row(*row) for row in rows],
        "trend": None if trend is None else _finite(_trend(trend)),
        "until_limit": None
        if until is None
        else _finite(
            {"median_s": until.median, "interval_s": list(until.interval), "probability": until.probability},
        ),
    }


def _trend(trend: Trend) -> Mapping[str, Any]:
    return {
        "time_s": trend.time,
        "updates": trend.updates,
        "gap_deg": math.degrees(trend.gap),
        "gap_interval_deg": [math.degrees(x) for x in trend.gap_interval],
        "rate_deg_per_s": math.degrees(trend.rate),
        "rate_interval_deg_per_s": [math.degrees(x) for x in trend.rate_interval],
    }


def _row(window: Window, estimate: GapEstimate, remarks: tuple[str, ...]) -> dict[str, Any]:
    row = {
        "start_s": window.start,
        "duration_s": window.duration,
        "time_s": estimate.time,
        "gap_deg": math.degrees(estimate.gap),
        "std_deg": math.degrees(estimate.std),
        "std_total_deg": math.degrees(estimate.std_total),
        "interval_deg": [math.degrees(x) for x in estimate.interval],
    }
    words = {"status": estimate.status.value, "reasons": list(estimate.reasons), "remarks": list(remarks)}
    return {**_finite(row), **words}


def _finite(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace infinity and NaN, which JSON does not have, by null."""

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(item) for item in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {key: plain(value) for key, value in values.items()}
