"""Prometheus' text format 0.0.4, for metrics.

No client library: the format is a page long, and nothing else of a library would be used.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class Sample(NamedTuple):
    """Value of a metric; `suffix` is added to its name, as in NAME_bucket."""

    value: float
    labels: Mapping[str, str] = {}  # never changed
    suffix: str = ""


def metric_lines(name: str, kind: str, help_: str, samples: Iterable[Sample]) -> Iterator[str]:
    """Lines of one metric; `kind` is "counter", "gauge", "histogram" or "summary"."""
    yield f"# HELP {name} {help_}"
    yield f"# TYPE {name} {kind}"
    for each in samples:
        yield f"{name}{each.suffix}{_labels(each.labels)} {number_text(each.value)}"


def number_text(value: float) -> str:
    """Text of a number."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else f"{value:.12g}"


def _labels(labels: Mapping[str, str]) -> str:
    pairs = ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items())
    return f"{{{pairs}}}" if pairs else ""


def _escaped(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
