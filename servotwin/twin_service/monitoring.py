"""Monitoring: metrics for Prometheus, and logs as JSON lines.

One thread updates the metrics, so that nothing is locked.
"""

from __future__ import annotations

import collections
import logging
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, TextIO

import msgspec

from servotwin.messages import Reason, Refusal
from servotwin.runtime.log_stream import LogStream
from servotwin.runtime.prometheus import Sample, metric_lines, number_text
from servotwin.runtime.token_bucket import TokenBucket

_SECONDS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
"""Upper bounds of the histograms' buckets."""

_WATCHED = ("alarm", "failed", "fallback", "withdrawn")
"""Kinds of evidence that an operator must see."""
_POSTED = ("taken", "refused", "dropped")
_MOST_LINES, _LINES_PER_S = 100.0, 1.0
_SERVERS = "uvicorn", "asyncio"
"""Loggers of the HTTP server."""
_Labels = tuple[str, ...]
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message", "taskName"}
"""Attributes that every log record has."""


class Counter:
    """Counter, one per combination of label values.

    Parameters
    ----------
    name, help_ : str
    labels : str
        Names of the labels, which have few values: the name of a servo is not a label.
    known : collection of str
        Values of the only label that are 0 from the start: of a series that appears, Prometheus sees no increase.
    """

    kind = "counter"

    def __init__(self, name: str, help_: str, *labels: str, known: Collection[str] = ()) -> None:
        self.name, self.help, self.labels = name, help_, labels
        none: dict[_Labels, int] = {(value,): 0 for value in known} if labels else {(): 0}
        self.values: collections.Counter[_Labels] = collections.Counter(none)

    def add(self, *values: str, by: int = 1) -> None:
        """Add to the counter of these label values."""
        self.values[values] += by

    def samples(self) -> Iterator[Sample]:
        """Values of all combinations."""
        for values, number in sorted(self.values.items()):
            yield Sample(number, dict(zip(self.labels, values, strict=True)))


class Gauge:
    """Gauge that is read when the metrics are; `read` returns a number, or one per value of its only label."""

    kind = "gauge"

    def __init__(self, name: str, help_: str, read: Callable[[], float | Mapping[str, float]], label: str = "") -> None:
        self.name, self.help, self._read, self._label = name, help_, read, label

    def samples(self) -> Iterator[Sample]:
        """Present values."""
        reading = self._read()
        if not isinstance(reading, Mapping):
            yield Sample(reading)
            return
        for value, number in sorted(reading.items()):
            yield Sample(number, {self._label: value})


class Histogram:
    """Histogram of times, s."""

    kind = "histogram"

    def __init__(self, name: str, help_: str, ends: Sequence[float] = _SECONDS) -> None:
        self.name, self.help, self._ends = name, help_, tuple(ends)
        self._counts, self._sum = [0] * (len(self._ends) + 1), 0.0

    def observe(self, value: float) -> None:
        """Add a time."""
        self._counts[bisect_left(self._ends, value)] += 1
        self._sum += value

    @property
    def count(self) -> int:
        """Number of times."""
        return sum(self._counts)

    def samples(self) -> Iterator[Sample]:
        """Buckets, sum and number."""
        below = 0
        for end, count in zip((*map(number_text, self._ends), "+Inf"), self._counts, strict=True):
            below += count
            yield Sample(below, {"le": end}, "_bucket")
        yield Sample(self._sum, suffix="_sum")
        yield Sample(below, suffix="_count")


class _LineLimit:
    """Limit of log lines of one kind: the first hundred, then one a second.

    Whoever makes the service write lines in a loop, a stranger too, must not fill the disk with them.
    """

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self._monotonic = monotonic
        self._buckets: dict[str, TokenBucket] = {}
        self._omitted = collections.Counter[str]()

    def take(self, kind: str) -> int | None:
        """Return how many lines of a kind were omitted before the present one; None: omit this one too."""
        if kind not in self._buckets:
            self._buckets[kind] = TokenBucket(_MOST_LINES, _LINES_PER_S, self._monotonic)
        if self._buckets[kind].take():
            return self._omitted.pop(kind, 0)
        self._omitted[kind] += 1
        return None


class RefusalLog:
    """Log lines of refused requests, limited for each code; all are counted.

    Parameters
    ----------
    log : Logger
    monotonic : callable
        s.
    """

    def __init__(self, log: logging.Logger, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._log, self._limit = log, _LineLimit(monotonic)

    def write(self, code: str, **about: Any) -> None:
        """Write a line, or count it; the next line of the code tells how many were `omitted`."""
        log, omitted = self._log, self._limit.take(code)
        if omitted is not None:
            log.info("refused", extra={**about, "code": code, **({"omitted": omitted} if omitted else {})})


class _ServerLines(logging.Filter):
    """Limits the lines of the HTTP server and of asyncio, one of which any bytes or connections may cause."""

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._limit = _LineLimit(monotonic)

    def filter(self, record: logging.LogRecord) -> bool:
        """Let a line pass, with the number of those `omitted` before it."""
        if not record.name.startswith(_SERVERS):
            return True
        omitted = self._limit.take(str(record.msg))
        if omitted:
            record.omitted = omitted
        return omitted is not None


class Metrics:
    """Metrics of the service."""

    def __init__(self) -> None:
        self.stored = Counter("servotwin_messages_total", "Messages committed, by kind and whether new.", "kind", "put")
        self.rejected = Counter(
            "servotwin_refused_total", "Messages and requests rejected, by reason code.", "code", known=list(Refusal)
        )
        self.repeated = Counter(
            "servotwin_requests_repeated_total", "Requests over the MQTT broker that had come before."
        )
        self.commit = Histogram("servotwin_commit_seconds", "From a message's last byte to its commit.")
        self.age = Histogram("servotwin_queue_age_seconds", "From a message's commit to that of its result.")
        self.work = Histogram("servotwin_work_seconds", "A worker's time for one servo's messages.")
        self.results = Counter("servotwin_outcomes_total", "Results of leases that workers processed.", "result")
        self.evidence = Counter(
            "servotwin_evidence_total", "Pieces of evidence committed, by kind.", "kind", known=_WATCHED
        )
        self.receipts = Counter(
            "servotwin_receipts_total", "Decisions of edges about updates, by reason.", "reason", known=list(Reason)
        )
        self.late = Counter(
            "servotwin_windows_late_total", "Windows without an update, because it would have come too late."
        )
        self.sent = Counter("servotwin_posted_total", "Messages posted to edges.")
        self.workers_lost = Counter("servotwin_workers_lost_total", "Worker processes that were replaced.")
        self.missing = Counter(
            "servotwin_windows_missing_total", "Windows of a boot that did not come, though later ones did."
        )
        self.webhook = Counter(
            "servotwin_webhook_total", "Alarms that were posted, by outcome.", "outcome", known=_POSTED
        )
        self._all: list[Counter | Gauge | Histogram] = [
            self.stored, self.rejected, self.repeated, self.commit, self.age, self.work, self.results, self.evidence,
            self.receipts, self.late, self.sent, self.workers_lost, self.missing, self.webhook,
        ]  # fmt: skip

    def add_gauge(
        self, name: str, help_: str, read: Callable[[], float | Mapping[str, float]], label: str = ""
    ) -> None:
        """Add a gauge."""
        self._all.append(Gauge(name, help_, read, label))

    def text(self) -> str:
        """All metrics in the text format."""
        return "".join(
            line + "\n" for each in self._all for line in metric_lines(each.name, each.kind, each.help, each.samples())
        )


def utc(seconds: float) -> str:
    """A time (s since the epoch) as log lines state it."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


class _JsonLines(logging.Formatter):
    """Formats a record as one JSON object: time, level, where, message and the fields of `extra`.

    Callers never give it a token, a header or a body.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return one line."""
        extra = {key: value for key, value in vars(record).items() if key not in _STANDARD}
        line: dict[str, Any] = {
            "time": utc(record.created),
            "level": record.levelname.lower(),
            "where": record.name,
            "message": record.getMessage(),
            **extra,
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return msgspec.json.encode(line, enc_hook=str).decode()


class _LinesNeverWaited(logging.Handler):
    """Writes lines without waiting for their reader, which would hold up all edges; counts those that are lost.

    Parameters
    ----------
    stream : TextIO
    """

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = LogStream(stream)

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record's line; the first one after lines that were lost has their number as `lines_lost`."""
        if self._stream.lost:
            record.lines_lost = self._stream.lost
        try:
            line = self.format(record)
        except Exception:  # a line that is wrong must not end what writes it
            self.handleError(record)
        else:
            self._stream.write(line)


def configure_logging(level: str, stream: TextIO | None = None) -> logging.Handler:
    """Log to `stream` (standard error) from `level` on; returns the handler, so that it can be removed.

    uvicorn and asyncio log only warnings: an access log would hold every request. The driver of PostgreSQL logs only
    errors: its warnings repeat in other words what it raises.
    """
    handler = _LinesNeverWaited(stream or sys.stderr)
    handler.setFormatter(_JsonLines())
    handler.addFilter(_ServerLines())
    service = logging.getLogger("servotwin")
    service.setLevel(level.upper())
    servers = [logging.getLogger(name) for name in _SERVERS]
    for server in servers:
        server.setLevel(logging.WARNING)
    driver = logging.getLogger("psycopg")
    driver.setLevel(logging.ERROR)
    for logger in (service, *servers, driver):
        logger.addHandler(handler)
        logger.propagate = False
    return handler
