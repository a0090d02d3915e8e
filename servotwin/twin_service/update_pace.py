"""Time that an update takes until its edge has decided on it, as the latest updates show it.

Only turns that led to an update count. Receipts, glances and windows without one take a moment, and say nothing of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from servotwin import messages
from servotwin.messages import Update
from servotwin.store.records import Lease, WorkResult
from servotwin.twin_service.ingest import Clocks

_KEPT = 16
"""Times that are kept."""
_FEW = 4
"""Of fewer times even the longest may be what is usual."""
_DOUBTED = 10.0
"""Times its validity without an update: then the machine may have become faster, and half the time is expected."""


class RecentTimes:
    """Latest times of one kind, s; they are doubted when no new one comes.

    Parameters
    ----------
    choose : callable
        Chooses the one that is expected, from all in rising order.
    """

    def __init__(self, choose: Callable[[Sequence[float]], float]) -> None:
        self._choose, self._times = choose, deque[float](maxlen=_KEPT)
        self._at, self._known, self._doubted = 0.0, 0.0, 1.0

    def note(self, seconds: float, now: float, validity: float) -> None:
        """Note a time; it replaces those that were doubted.

        Parameters
        ----------
        seconds, now : float
            `now`: monotonic.
        validity : float
            s for which updates of this kind may be applied.
        """
        if self._halvings(now):
            self._times.clear()
        self._times.append(seconds)
        self._at, self._known = now, self._choose(sorted(self._times))
        # What takes much longer than it may is not tried so often either that it takes all of a worker's time.
        self._doubted = max(_DOUBTED * validity, self._known)

    def expected(self, now: float) -> float:
        """Time that is to be expected, s; 0: nothing is known, so that a first one is tried."""
        return float(self._known * 0.5 ** self._halvings(now))

    def _halvings(self, now: float) -> int:
        return int((now - self._at) / self._doubted)


class _Sent(NamedTuple):
    """An update without a receipt so far."""

    version: int
    time: float
    validity: float


class UpdatePace:
    """Expected time from the begin of a servo's work until its edge has decided on the update.

    Servos of one model are counted together: with a table a setting takes a moment, without one it takes seconds.

    Parameters
    ----------
    model_of : callable
        Name of a servo's model.
    clocks : Clocks
    """

    def __init__(self, model_of: Callable[[str], str | None], clocks: Clocks) -> None:
        self._model_of, self._clocks = model_of, clocks
        self._work, self._way = dict[str | None, RecentTimes](), dict[str | None, RecentTimes]()
        self._sent: dict[str, _Sent] = {}

    def expected(self, servo: str) -> float:
        """s that an update for this servo takes: a high value of its work's times, and the usual time of its way."""
        model, now = self._model_of(servo), self._clocks.monotonic()
        return sum(times[model].expected(now) for times in (self._work, self._way) if model in times)

    def note_work(self, result: WorkResult, seconds: float) -> None:
        """Note a result whose work took so long, before it is committed: the next work may begin meanwhile."""
        if (update := _update_of(result)) is None:
            return
        model, validity = self._model_of(result.servo), update.not_after - update.data_time
        if model in self._work:
            self._work[model].note(seconds, self._clocks.monotonic(), validity)
        else:  # the first one may have compiled for a minute
            self._work[model] = RecentTimes(_high)

    def note_ways(self, lease: Lease, result: WorkResult) -> None:
        """Note with a result that was just committed the times from updates to their receipts, and when it sent one.

        A window takes as long to the twin, and an update back.
        """
        received = {message.id: message.received for message in lease.messages}
        for row in result.evidence:
            sent = self._sent.get(lease.servo)
            if row.kind != "receipt" or row.message not in received or sent is None or sent.version != row.version:
                continue
            del self._sent[lease.servo]
            way = max(0.0, received[row.message] - sent.time)
            if way <= sent.validity:  # otherwise the edge was away, which tells nothing of the others
                times = self._way.setdefault(self._model_of(lease.servo), RecentTimes(_middle))
                times.note(way, self._clocks.monotonic(), sent.validity)
        if (update := _update_of(result)) is not None:
            validity = update.not_after - update.data_time
            self._sent[lease.servo] = _Sent(update.version, self._clocks.wall(), validity)


def _high(times: Sequence[float]) -> float:
    """Longest but one: of many, one that took very long was an exception."""
    return times[-1] if len(times) < _FEW else times[-2]


def _middle(times: Sequence[float]) -> float:
    return times[len(times) // 2]


def _update_of(result: WorkResult) -> Update | None:
    """Update to which a window of this work led; None: there is none, or an earlier one was sent again."""
    if not any(row.kind == "redesign" and not row.status for row in result.evidence):
        return None
    sent = (messages.decode(body) for body in result.outgoing)
    return next((message for message in sent if isinstance(message, Update)), None)
