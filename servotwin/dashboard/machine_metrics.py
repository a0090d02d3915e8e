"""Metrics of each machine for Prometheus, from the rows of the fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from servotwin.dashboard.fleet import FleetRow
from servotwin.runtime.prometheus import Sample, metric_lines

_METRICS: tuple[tuple[str, str, Callable[[FleetRow], float | None]], ...] = (
    ("gap_radians", "Gap of the newest window.", lambda row: row.gap),
    ("gap_low_radians", "Low end of its 95 % interval.", lambda row: None if row.interval is None else row.interval[0]),
    (
        "gap_high_radians",
        "High end of its 95 % interval; absent where unbounded.",
        lambda row: None if row.interval is None else row.interval[1],
    ),
    ("gap_limit_radians", "Largest acceptable gap.", lambda row: row.gap_limit),
    ("wear_radians_per_second", "Rate of the trend, in machine time.", lambda row: row.rate),
    ("limit_seconds", "Machine time until the trend reaches the limit.", lambda row: row.until_limit),
    ("version", "Version in force, as the edge reported it last.", lambda row: row.version_in_force),
    ("connected", "1: the edge holds a connection; absent where that cannot be known.", lambda row: row.connected),
    ("last_message_seconds", "Time of the last message, s since the epoch.", lambda row: row.last_message),
    ("alarms", "Alarms of the last day.", lambda row: len(row.alarms)),
)  # fmt: skip


def machine_metrics(rows: Sequence[FleetRow]) -> str:
    """All metrics in the text format; a value that is unknown is absent."""
    return "".join(f"{line}\n" for line in _lines(rows))


def _lines(rows: Sequence[FleetRow]) -> Iterator[str]:
    for name, help_, read in _METRICS:
        known = ((row.servo, read(row)) for row in rows)
        samples = (Sample(float(value), {"servo": servo}) for servo, value in known if value is not None)
        yield from metric_lines(f"servotwin_machine_{name}", "gauge", help_, samples)
