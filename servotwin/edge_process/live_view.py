"""The live view in the link process: while somebody watches, the extremes of the newest samples go to the twin.

It reads the samples from shared memory, in a thread and over a connection of its own: neither the tick nor windows and
letters wait for it. What cannot be sent at once is never sent.
"""

from __future__ import annotations

import random
from array import array
from collections import Counter
from collections.abc import Callable
from math import isfinite
from threading import Event
from typing import Protocol

from servotwin.edge.outlet import CHANNELS, recorded_channels
from servotwin.edge_process.shared_samples import SampleReader
from servotwin.link.claim import HeldClaim
from servotwin.link.transport import Refused, Unreachable
from servotwin.messages import Refusal
from servotwin.messages.checks import all_finite
from servotwin.messages.live import COLUMN_S, MAX_LIVE_COLUMNS, LiveColumn, LiveColumns
from servotwin.runtime.retry import Backoff, Retry

SEND_S = 0.5
"""s between two messages while somebody watches."""
_UNCLAIMED_S, _OLDER_TWIN_S = 0.5, 600.0
"""s until the next look whether the servo is claimed; until the next try at a twin without the live view."""


class LiveLink(Protocol):
    """Connection to the twin, as `servotwin.link.http.LiveHttp`."""

    def send(self, columns: LiveColumns, claim: HeldClaim) -> bool:
        """Send columns; without any, wait until somebody watches. Raises Refused or Unreachable."""

    def close(self) -> None:
        """Close it; a request under way fails at once."""


class LiveView:
    """Sends columns while somebody watches, and waits otherwise.

    Parameters
    ----------
    link : LiveLink
    samples : SampleReader
    servo : str
    rate : float
        Of the samples, Hz.
    claim : callable
        Returns the claim that is held; nothing is sent without one.
    stopping : Event

    Attributes
    ----------
    counts : Counter
        Columns sent, columns skipped, and failures.
    """

    def __init__(
        self,
        link: LiveLink,
        samples: SampleReader,
        servo: str,
        rate: float,
        claim: Callable[[], HeldClaim],
        stopping: Event,
    ) -> None:
        self._link, self._samples, self._servo, self._rate = link, samples, servo, rate
        self._claim, self._stopping = claim, stopping
        self._width = max(1, round(COLUMN_S * rate))
        self._backoff = Backoff(Retry())
        self._watched, self._recorded, self._next = False, 0, 0
        self.counts: Counter[str] = Counter()

    def run(self) -> None:
        """Run until it is stopped."""
        while not self._stopping.is_set():
            self._stopping.wait(self.step())

    def close(self) -> None:
        """End a request under way."""
        self._link.close()

    def step(self) -> float:
        """Send what is new, or wait for a watcher; return the time until the next step, s."""
        claim = self._claim()
        if not claim.number:
            return _UNCLAIMED_S
        before = self._watched
        columns = self._columns() if before else LiveColumns(self._servo)
        try:
            self._watched = self._link.send(columns, claim)
        except Refused as error:
            return self._failed(f"refused: {error.reason.value}", error)
        except Unreachable as error:
            return self._failed("unreachable", error)
        self._backoff.succeeded()
        self.counts["columns"] += len(columns.columns)
        if self._watched and not before:
            self._begin()
        return SEND_S if self._watched else 0.0

    def _failed(self, count: str, error: Refused | Unreachable) -> float:
        self._watched = False
        self.counts[count] += 1
        pause = self._backoff.failed(random.random())
        older = isinstance(error, Refused) and error.reason is Refusal.UNKNOWN_SCHEMA
        return _OLDER_TWIN_S if older else max(pause, error.after_s if isinstance(error, Refused) else 0.0)

    def _begin(self) -> None:
        """Begin with the column that is being recorded."""
        self._recorded, samples = self._samples.position
        self._next = samples // self._width

    def _columns(self) -> LiveColumns:
        """Columns that are complete and not sent yet; of too many the newest."""
        recorded, samples = self._samples.position
        if recorded != self._recorded:
            self._begin()
        complete = samples // self._width
        first = max(self._next, complete - MAX_LIVE_COLUMNS)
        self.counts["columns skipped"] += first - self._next
        columns: list[LiveColumn] = []
        for number in range(first, complete):
            read = self._samples.read(number * self._width, (number + 1) * self._width)
            if read is None or read.boot != self._recorded:
                self.counts["columns skipped"] += len(columns) + 1
                first, columns = number + 1, []
            else:
                names = recorded_channels(len(read.channels) == len(CHANNELS))
                columns.append(live_column(dict(zip(names, read.channels, strict=True))))
        self._next = complete
        return LiveColumns(self._servo, self._recorded, first, self._width / self._rate, tuple(columns))


def live_column(samples: dict[str, array[float]]) -> LiveColumn:
    """Least and greatest position, error and command of a column of samples."""
    error = map(float.__sub__, samples["reference"], samples["position"])
    return (*_extremes(samples["position"]), *_extremes(array("d", error)), *_extremes(samples["voltage"]))


def _extremes(values: array[float]) -> tuple[float | None, float | None]:
    # Where one is no number, least and greatest of all would depend on its place.
    good = values if all_finite(values) else [value for value in values if isfinite(value)]
    return (min(good), max(good)) if good else (None, None)
