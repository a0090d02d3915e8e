"""Pace of backlogs: after an outage of a whole fleet its older windows come no faster than beside the newest ones.

Storing a window takes processor time that the workers need for the newest ones. Each edge is therefore told the pause
before each window that a newer one has overtaken. All of it is in memory: after a restart the edges say again, with each
window, what they have.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from contextlib import suppress

from servotwin.link.transport import LONGEST_OLDER_PAUSE_S
from servotwin.store.engine import StoreUnavailable
from servotwin.twin_service.limits import MAX_SERVOS

LOOK_S = 2.0
"""s between two looks at the lag while edges have backlogs."""
_SHORTEST_PAUSE_S = 1.0
"""Where all edges with a backlog send a window within this time, s, nothing is gained by a pause."""
_SHARE = 0.25
"""Cores that storing of older windows may always use."""
_FIRST_COST_S, _BUSY, _FORGETTING = 1e-3, 200.0, 0.2
"""s of processor time for one window until it is measured; windows in one measurement, which is no measurement of a
process that mostly rests; weight of the newest one."""
_LAG, _LONGEST_LAG_S = 0.1, 3.0
"""Part of the lag limit for which new messages may wait for a worker while backlogs come in; at most so many s."""
_FASTER, _SLOWER = 1.4, 0.7
_FORGET_S, _GONE_S = 3600.0, 3.0 * LONGEST_OLDER_PAUSE_S
"""s without a window after which a servo does not count as one of the fleet, and after which it has no backlog."""


class BacklogPace:
    """Pause before older windows, from how many edges have some and from the lag of new ones.

    Parameters
    ----------
    monotonic : callable
        s.
    lag_limit_s : float
        Time for which new messages may wait before the service reports itself as degraded, s.
    processor : callable
        Processor time that this process has used, s.
    """

    def __init__(
        self, monotonic: Callable[[], float], lag_limit_s: float, processor: Callable[[], float] = time.process_time
    ) -> None:
        self._now, self._processor = monotonic, processor
        self._lag = min(_LAG * lag_limit_s, _LONGEST_LAG_S)
        self._fleet, self._behind = OrderedDict[str, float](), OrderedDict[str, float]()
        self._cost, self._taken, self._since, self._used = _FIRST_COST_S, 0, monotonic(), processor()
        self._rate, self._changed = 0.0, monotonic()

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
        self._count_window(now)
        _note(self._fleet, servo, now, _FORGET_S)
        if waiting:
            _note(self._behind, servo, now, _GONE_S)
        else:
            self._behind.pop(servo, None)
        pause = self._pause(len(self._behind), self._rate) if waiting else self._pause(len(self._fleet), 0.0)
        return pause if pause >= _SHORTEST_PAUSE_S else 0.0

    async def run(self, lag: Callable[[], Awaitable[float]]) -> None:
        """Look at the lag (s) every few seconds while edges have backlogs."""
        while True:
            await asyncio.sleep(LOOK_S)
            with suppress(StoreUnavailable):
                self.note_lag(await lag() if self.behind else 0.0)

    def note_lag(self, seconds: float) -> None:
        """Note for how long new messages wait for a worker; older windows are then asked for faster, or slower."""
        now, pause = self._now(), self._pause(self.behind, self._rate)
        _forget(self._behind, now, _GONE_S)
        if not self.behind:
            self._rate, self._changed = 0.0, now
        elif now - self._changed >= pause:  # the edges have followed the last change
            least = self.behind / self._pause(self.behind, 0.0)
            self._rate = max(self._rate, least) * (_FASTER if seconds <= self._lag else _SLOWER)
            self._changed = now

    def _pause(self, servos: int, rate: float) -> float:
        """Pause of each of some servos at a rate of all of them, windows/s, which has a lower limit."""
        return min(servos / max(rate, _SHARE / self._cost), LONGEST_OLDER_PAUSE_S)

    def _count_window(self, now: float) -> None:
        """Measure the processor time that a window takes, while many come."""
        self._taken += 1
        if now - self._since < LOOK_S:
            return
        used = self._processor()
        if self._taken >= _BUSY:
            self._cost += _FORGETTING * ((used - self._used) / self._taken - self._cost)
        self._taken, self._since, self._used = 0, now, used


def _note(servos: OrderedDict[str, float], servo: str, now: float, longest: float) -> None:
    """Note when a servo sent a window, and forget those that sent none for a time (s)."""
    servos[servo] = now
    servos.move_to_end(servo)
    if len(servos) > MAX_SERVOS:
        servos.popitem(last=False)
    _forget(servos, now, longest)


def _forget(servos: OrderedDict[str, float], now: float, longest: float) -> None:
    while servos and next(iter(servos.values())) < now - longest:
        servos.popitem(last=False)
