"""Pace of backlogs: after an outage of a whole fleet its older windows come no faster than beside the newest ones.

Storing and looking at a window takes processor time that the newest ones need. Each edge is therefore told the pause
before each window that a newer one has overtaken. All of it is in memory: after a restart the edges say again, with
each window, what they have.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import TypeVar

from servotwin.link.transport import LONGEST_OLDER_PAUSE_S
from servotwin.link.window_order import FRESH_S
from servotwin.store.engine import StoreUnavailable
from servotwin.twin_service.limits import MAX_SERVOS

NEWEST_S = 30.0
"""s that the newest windows of a fleet have for themselves once its link is back."""
_FIRST_SPREAD = 0.5
"""Part of that time over which the first older windows of a fleet are spread: its edges come back at once."""
LOOK_S = 2.0
"""s between two looks at the lag while edges have backlogs."""
_SHORTEST_PAUSE_S = 1.0
"""Where all edges with a backlog send a window within this time, s, nothing is gained by a pause."""
_FIRST_SHARE, _LEAST_SHARE, _FIRST_WORK_S = 0.25, 0.05, 1e-3
"""Share of the workers' capacity at which older windows are asked for at first, and at least, however long new messages
wait; and s of work for one window until that is measured. New ones need the workers too, and all need the store."""
_LEAST_PER_S = 50.0
"""Older windows/s that are always asked for: storing these takes a few percent of a core."""
_LAG, _LONGEST_LAG_S = 0.1, 3.0
"""Part of the lag limit for which new messages may wait for a worker while backlogs come in; at most so many s."""
_MUCH_FASTER, _FASTER, _SLOWER = 2.0, 1.2, 0.7
"""Factors of the rate at each change: where new messages wait for less than a third of that time, for less than all of
it, and for longer."""
_FORGET_S, _GONE_S = 3600.0, 2.0 * LONGEST_OLDER_PAUSE_S
"""s without a window after which a servo does not count as one of the fleet, and after which it has no backlog."""

_Value = TypeVar("_Value")


class BacklogPace:
    """Pause before older windows, from how many edges have some and from the lag of new ones.

    Parameters
    ----------
    monotonic : callable
        s.
    lag_limit_s : float
        Time for which new messages may wait before the service reports itself as degraded, s.
    work_s : callable
        Time after which the workers are done with a further servo's new messages, s; 0: not known yet.
    """

    def __init__(
        self, monotonic: Callable[[], float], lag_limit_s: float, work_s: Callable[[], float] = lambda: 0.0
    ) -> None:
        self._now, self._work_s = monotonic, work_s
        self._lag = min(_LAG * lag_limit_s, _LONGEST_LAG_S)
        self._fleet, self._behind = OrderedDict[str, float](), OrderedDict[str, float]()
        self._newest = OrderedDict[str, tuple[str, float]]()
        self._rate, self._changed = 0.0, monotonic()

    def has_overtaken(self, servo: str, boot: str, start: float) -> bool:
        """True where a newer window of a boot came before the one that starts at `start` (s of sample time)."""
        newest = self._newest.get(servo)
        return newest is not None and newest[0] == boot and start < newest[1]

    def note(self, servo: str, boot: str, start: float) -> None:
        """Note a window that was committed."""
        if not self.has_overtaken(servo, boot, start):
            _note(self._newest, servo, (boot, start))

    @property
    def behind(self) -> int:
        """Number of servos whose edges have older windows to send."""
        return len(self._behind)

    def pause(self, servo: str, waiting: int) -> float:
        """Pause that a servo's edge is asked for before each window that a newer one has overtaken, s; 0: none.

        An edge without a backlog is told what it would be if the whole fleet came back at once: it then knows after an
        outage whether its older windows would hold up the newest one.

        Parameters
        ----------
        servo : str
            It has just sent a window.
        waiting : int
            Number of windows that it has to send beside that.
        """
        now = self._now()
        _note(self._fleet, servo, now)
        _forget(self._fleet, now, _FORGET_S)
        whole = min(len(self._fleet) / self._first_rate, LONGEST_OLDER_PAUSE_S)
        if not waiting:
            self._behind.pop(servo, None)
            return _told(whole)
        has_begun, first = servo in self._behind, self._first_pause(whole, waiting)
        if not self._behind:
            # Until the first pauses are over, no older windows are what new messages wait for.
            self._rate, self._changed = self._first_rate, now + first
        _note(self._behind, servo, now)
        _forget(self._behind, now, _GONE_S)
        return _told(self._pause) if has_begun else first

    def _first_pause(self, whole: float, waiting: int) -> float:
        """Pause (s) before the first of so many older windows of an edge, where those of a fleet are `whole` apart.

        Those that would come out of their order in any case leave the first time to the newest windows of all edges.
        """
        pause = _told(whole)
        if waiting * pause <= FRESH_S:
            return pause
        return NEWEST_S * (1.0 + _FIRST_SPREAD * self.behind / len(self._fleet))

    def holds(self, servo: str) -> bool:
        """True where a servo's edge waits before older windows because it was asked to."""
        if servo not in self._behind or not _told(max(self._pause, len(self._fleet) / self._first_rate)):
            return False
        return self._now() - self._behind[servo] <= _GONE_S

    async def run(self, lag: Callable[[], Awaitable[float]]) -> None:
        """Look at the lag (s) every few seconds while edges have backlogs."""
        while True:
            await asyncio.sleep(LOOK_S)
            with suppress(StoreUnavailable):
                if self.behind:
                    self.note_lag(await lag())

    def note_lag(self, seconds: float) -> None:
        """Note for how long new messages wait for a worker; older windows are then asked for faster, or slower."""
        now = self._now()
        _forget(self._behind, now, _GONE_S)
        if not self.behind or now - self._changed < self._pause:  # the edges have not followed the last change yet
            return
        # Where no edge is told a pause nobody tries a higher rate, and a whole fleet that comes back would meet it.
        faster = 1.0 if not _told(self._pause) else _MUCH_FASTER if seconds <= self._lag / 3.0 else _FASTER
        least = max(self._capacity * _LEAST_SHARE, _LEAST_PER_S, self.behind / LONGEST_OLDER_PAUSE_S)
        self._rate = max(self._rate * (faster if seconds <= self._lag else _SLOWER), least)
        self._changed = now

    @property
    def _capacity(self) -> float:
        """Windows/s that the workers can look at."""
        return 1.0 / (self._work_s() or _FIRST_WORK_S)

    @property
    def _first_rate(self) -> float:
        """Older windows/s that are asked for at first."""
        return max(_FIRST_SHARE * self._capacity, _LEAST_PER_S)

    @property
    def _pause(self) -> float:
        return min(self.behind / self._rate, LONGEST_OLDER_PAUSE_S)


def _told(pause: float) -> float:
    """Pause (s) as an edge is told, where it is worth one."""
    return min(pause, LONGEST_OLDER_PAUSE_S) if pause >= _SHORTEST_PAUSE_S else 0.0


def _note(servos: OrderedDict[str, _Value], servo: str, value: _Value) -> None:
    """Note something of a servo, which is then the one that is forgotten last."""
    servos[servo] = value
    servos.move_to_end(servo)
    if len(servos) > MAX_SERVOS:
        servos.popitem(last=False)


def _forget(servos: OrderedDict[str, float], now: float, longest: float) -> None:
    """Forget the servos that sent nothing for a time (s)."""
    while servos and next(iter(servos.values())) < now - longest:
        servos.popitem(last=False)
