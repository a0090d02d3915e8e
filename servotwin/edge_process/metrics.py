"""Metrics of an edge as a file in Prometheus' text format, from its status, for node_exporter's textfile collector.

A file and no port: nothing on a machine's controller listens to the network, and a status that is no longer written
shows in `servotwin_edge_written_seconds`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from servotwin.edge.outlet import FILTERED, NOT_FINITE
from servotwin.edge_process.outlet import BEHIND
from servotwin.link.outbox import FULL
from servotwin.link.outbox_contents import BROKEN, UNWRITABLE
from servotwin.link.sqlite_outbox import ANOTHER, INCOMPLETE, LETTERS, MOVED
from servotwin.messages import Refusal
from servotwin.runtime.files import replace_file
from servotwin.runtime.prometheus import Sample, metric_lines

_REFUSED = tuple(refusal.value for refusal in Refusal if not refusal.temporary)
_READABLE = 0o644
"""The collector runs as another user; nothing in the file is secret."""


class _Metric(NamedTuple):
    """Metric, and its place in the status: a number, a flag, or a table with one number per value of `label`."""

    name: str
    kind: str
    help: str
    path: tuple[str, ...]
    label: str = ""
    known: tuple[str, ...] = ()


_QUANTILES = {"median_us": "0.5", "p99_us": "0.99", "p999_us": "0.999", "max_us": "1"}
_METRICS = (
    _Metric("servotwin_edge_written_seconds", "gauge", "Time of this status since the epoch.", ("written",)),
    _Metric("servotwin_edge_samples_total", "counter", "Samples of this boot.", ("samples",)),
    _Metric("servotwin_edge_windows_cut_total", "counter", "Windows recorded in this boot.", ("windows_cut",)),
    _Metric(
        "servotwin_edge_windows_waiting", "gauge", "Windows that the twin has not acknowledged.", ("windows", "waiting")
    ),
    _Metric(
        "servotwin_edge_windows_dropped_total",
        "counter",
        "Windows that were never sent, by reason.",
        ("windows", "dropped"),
        "reason",
        (BEHIND, BROKEN, FILTERED, FULL, INCOMPLETE, LETTERS, NOT_FINITE, UNWRITABLE, *_REFUSED),
    ),
    _Metric("servotwin_edge_disk_safe", "gauge", "1: all that must be on the disk is there.", ("disk", "safe")),
    _Metric(
        "servotwin_edge_disk_faults_total",
        "counter",
        "Faults of the disk.",
        ("disk", "faults"),
        "fault",
        (ANOTHER, BROKEN, INCOMPLETE, MOVED, UNWRITABLE),
    ),
    _Metric("servotwin_edge_version", "gauge", "Version of the setting in force.", ("version",)),
    _Metric("servotwin_edge_fallback", "gauge", "1: the fallback set is in force.", ("fallback",)),
    _Metric("servotwin_edge_conflict", "gauge", "1: another edge of the servo has taken over.", ("conflict",)),
    _Metric("servotwin_edge_tolerance_metres", "gauge", "Half width of the dead zone in force.", ("tolerance_m",)),
    _Metric(
        "servotwin_edge_tolerance_radians",
        "gauge",
        "Half width of the dead zone in force, of a rotary axis.",
        ("tolerance_rad",),
    ),
)


def metrics_text(status: Mapping[str, Any]) -> str:
    """Metrics of a status, as in `status.json`; those that it does not hold are left out."""
    servo = {"servo": str(status.get("servo", ""))}
    lines = [line for metric in _METRICS for line in _lines(metric, status, servo)]
    lines += _link_lines(status, servo)
    lines += _tick_lines(status, servo)
    return "".join(f"{line}\n" for line in lines)


def write_metrics(path: Path, status: Mapping[str, Any]) -> None:
    """Replace the file of metrics, at once; raises OSError."""
    replace_file(path, metrics_text(status).encode(), mode=_READABLE)


def _lines(metric: _Metric, status: Mapping[str, Any], servo: Mapping[str, str]) -> Iterator[str]:
    value: Any = status
    for name in metric.path:
        value = value.get(name) if isinstance(value, Mapping) else None
    if metric.label and isinstance(value, Mapping):
        # From 0 on: of a series that appears, Prometheus sees no increase.
        numbers = {**dict.fromkeys(metric.known, 0), **value}
        samples = [Sample(number, {**servo, metric.label: name}) for name, number in sorted(numbers.items())]
        yield from metric_lines(metric.name, metric.kind, metric.help, samples)
    elif isinstance(value, int | float):
        yield from metric_lines(metric.name, metric.kind, metric.help, [Sample(value, servo)])


def _link_lines(status: Mapping[str, Any], servo: Mapping[str, str]) -> Iterator[str]:
    """Lines that tell whether the twin is reached, in each direction; nothing for an edge without a twin."""
    ways = {name: status[name] for name in ("up", "down") if isinstance(status.get(name), Mapping)}
    samples = [Sample(not way.get("trouble"), {**servo, "way": name}) for name, way in ways.items()]
    if samples:
        yield from metric_lines("servotwin_edge_link_ok", "gauge", "1: the twin answers, by direction.", samples)


def _tick_lines(status: Mapping[str, Any], servo: Mapping[str, str]) -> Iterator[str]:
    tick = status.get("tick")
    if not isinstance(tick, Mapping):
        return
    samples = [Sample(tick[name] * 1e-6, {**servo, "quantile": share}) for name, share in _QUANTILES.items()]
    samples.append(Sample(tick["number"], servo, "_count"))
    yield from metric_lines("servotwin_edge_tick_seconds", "summary", "Time of a tick of the control loop.", samples)
