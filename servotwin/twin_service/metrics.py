"""Counters, gauges and histograms, told as Prometheus' text format 0.0.4; one thread writes, nothing is locked.

By hand: the format is a page long, and nothing else of a client library would be used.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SECONDS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
"""Upper ends of the histograms' classes."""

Labels = tuple[str, ...]


class Count:
    """A number that only rises, for each set of labels.

    Parameters
    ----------
    name, help_ : str
    labels : str
        Names of the labels; their values are few: a servo's name is none.
    """

    kind = "counter"

    def __init__(self, name: str, help_: str, *labels: str) -> None:
        self.name, self.help, self.labels = name, help_, labels
        self.values: Counter[Labels] = Counter() if labels else Counter({(): 0})

    def add(self, *values: str, by: int = 1) -> None:
        """One more of what has these labels' values."""
        self.values[values] += by

    def lines(self) -> Iterator[str]:
        """The samples."""
        for values, number in sorted(self.values.items()):
            yield f"{self.name}{_labels(self.labels, values)} {number}"


class Gauge:
    """A number that is asked for when somebody looks; `read` gives one, or one per value of the only label."""

    kind = "gauge"

    def __init__(self, name: str, help_: str, read: Callable[[], float | Mapping[str, float]], label: str = "") -> None:
        self.name, self.help, self._read, self._label = name, help_, read, label

    def lines(self) -> Iterator[str]:
        """The samples."""
        found = self._read()
        if not isinstance(found, Mapping):
            yield f"{self.name} {_number(found)}"
            return
        for value, number in sorted(found.items()):
            yield f"{self.name}{_labels((self._label,), (value,))} {_number(number)}"


class Histogram:
    """How often a time (s) fell into which class."""

    kind = "histogram"

    def __init__(self, name: str, help_: str, ends: Sequence[float] = SECONDS) -> None:
        self.name, self.help, self._ends = name, help_, tuple(ends)
        self._counts, self._sum = [0] * (len(self._ends) + 1), 0.0

    def observe(self, value: float) -> None:
        """One more."""
        self._counts[bisect_left(self._ends, value)] += 1
        self._sum += value

    @property
    def count(self) -> int:
        """How many there were."""
        return sum(self._counts)

    def lines(self) -> Iterator[str]:
        """The samples."""
        below = 0
        for end, count in zip((*map(_number, self._ends), "+Inf"), self._counts, strict=True):
            below += count
            yield f'{self.name}_bucket{{le="{end}"}} {below}'
        yield f"{self.name}_sum {_number(self._sum)}"
        yield f"{self.name}_count {below}"


class Metrics:
    """Everything that the service counts."""

    def __init__(self) -> None:
        self.taken = Count("servotwin_messages_total", "Messages committed, by kind and whether new.", "kind", "put")
        self.refused = Count("servotwin_refused_total", "Messages and requests not taken, by reason code.", "code")
        self.commit = Histogram("servotwin_commit_seconds", "From a message's last byte to its commit.")
        self.age = Histogram("servotwin_queue_age_seconds", "From a message's commit to that of its outcome.")
        self.work = Histogram("servotwin_work_seconds", "A worker's time for one servo's messages.")
        self.outcomes = Count("servotwin_outcomes_total", "What became of servos lent to workers.", "result")
        self.evidence = Count("servotwin_evidence_total", "What twins found and did, by kind.", "kind")
        self.posted = Count("servotwin_posted_total", "Messages made for edges.")
        self.workers_lost = Count("servotwin_workers_lost_total", "Worker processes that had to be replaced.")
        self._all: list[Count | Gauge | Histogram] = [
            self.taken, self.refused, self.commit, self.age, self.work, self.outcomes, self.evidence, self.posted,
            self.workers_lost,
        ]  # fmt: skip

    def watch(self, name: str, help_: str, read: Callable[[], float | Mapping[str, float]], label: str = "") -> None:
        """Tell another gauge as well."""
        self._all.append(Gauge(name, help_, read, label))

    def text(self) -> str:
        """All of it."""
        return "".join(line + "\n" for metric in self._all for line in _told(metric))


def _told(metric: Count | Gauge | Histogram) -> Iterator[str]:
    yield f"# HELP {metric.name} {metric.help}"
    yield f"# TYPE {metric.name} {metric.kind}"
    yield from metric.lines()


def _labels(names: Sequence[str], values: Sequence[str]) -> str:
    pairs = ",".join(f'{name}="{_escaped(value)}"' for name, value in zip(names, values, strict=True))
    return f"{{{pairs}}}" if pairs else ""


def _escaped(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _number(value: float) -> str:
    return f"{value:.12g}"
