"""Clocks with an event queue: virtual time, or the wall clock's.

Events are ordered by (time, priority, serial), so equal times resolve the same way in every run.
"""

import heapq
from collections.abc import Callable
from typing import NamedTuple

Action = Callable[[], object]


class Event(NamedTuple):
    """Action and its time (s); at equal times the lower priority goes first, then the event scheduled first."""

    time: float
    priority: int
    serial: int
    action: Action


class VirtualClock:
    """A clock that jumps from event to event.

    Parameters
    ----------
    now : float
        Time at the start, s.
    """

    def __init__(self, now: float = 0.0) -> None:
        self._now = now
        self._serial = 0
        self._queue: list[Event] = []

    @property
    def now(self) -> float:
        """Present time, s."""
        return self._now

    @property
    def next_time(self) -> float | None:
        """Time at which the next event is due, s; None: nothing is scheduled."""
        return self._queue[0].time if self._queue else None

    def schedule(self, time: float, action: Action, priority: int = 0) -> Event:
        """Call `action` at `time`; the returned event can be cancelled.

        Raises
        ------
        ValueError
            When the time has passed or is not a number.
        """
        if not time >= self._now:
            raise ValueError(f"cannot schedule at {time} s: it is {self._now} s")
        event = Event(time, priority, self._serial, action)
        self._serial += 1
        heapq.heappush(self._queue, event)
        return event

    def cancel(self, event: Event) -> bool:
        """Remove an event from the queue; False when it has happened already."""
        if event not in self._queue:
            return False
        self._queue.remove(event)
        heapq.heapify(self._queue)
        return True

    def step(self) -> None:
        """Advance to the next event and perform it."""
        event = heapq.heappop(self._queue)
        self._now = event.time
        event.action()

    def run_until(self, time: float) -> None:
        """Perform all events up to and including `time`, and advance to it."""
        while self._queue and self._queue[0].time <= time:
            self.step()
        self._now = max(self._now, time)


class WallClock:
    """A clock that sleeps until each event of the same queue is due.

    Parameters
    ----------
    source : callable
        Returns monotonic seconds; the clock's zero is the value at construction.
    sleep : callable
        Called with the seconds to wait.
    """

    def __init__(self, source: Callable[[], float], sleep: Callable[[float], object]) -> None:
        self._source, self._sleep = source, sleep
        self._zero = source()
        self._events = VirtualClock()

    @property
    def now(self) -> float:
        """Seconds since the clock was made."""
        return self._source() - self._zero

    @property
    def next_time(self) -> float | None:
        """Time at which the next event is due, s; None: nothing is scheduled."""
        return self._events.next_time

    def schedule(self, time: float, action: Action, priority: int = 0) -> Event:
        """Call `action` at `time`, or as soon as possible when that time has passed."""
        return self._events.schedule(max(time, self._events.now), action, priority)

    def cancel(self, event: Event) -> bool:
        """Remove an event from the queue; False when it has happened already."""
        return self._events.cancel(event)

    def run_until(self, time: float) -> None:
        """Perform all events up to and including `time`, each at its time or late, and wait until `time`."""
        while (due := self.next_time) is not None and due <= time:
            self._wait(due)
            self._events.step()
        self._wait(time)
        self._events.run_until(time)

    def _wait(self, time: float) -> None:
        while (left := time - self.now) > 0.0:
            self._sleep(left)
