"""Shares of the workers' time: of verifications, of estimates that were deferred, and of each servo."""

from __future__ import annotations

_SERVOS = 16
"""Servos in one job, at most."""
_JOB_S = 0.5
"""s that a job may be expected to take: a servo in it has no newer messages than those of its lease."""
_FORGETTING = 0.1
"""Weight of the newest work in the mean time for one servo."""
_SHORTEST_HOLD_S = 0.1
"""A shorter hold is not worth a write."""
_ESTIMATES = 0.25
"""Share of the time that estimates get although new messages wait; what these leave free they get anyway."""
_MOST_OWED_S = 1.0
"""s of estimates that may be owed, or were taken in advance: idle times do not add up."""


class VerificationQuota:
    """Token bucket for verifications, two at most, and of these not as many at once as there are workers.

    Each takes a worker for a second, for which new messages would wait if no worker were left for them.

    Parameters
    ----------
    per_minute : float
        0: none is started.
    workers : int
        One alone does verifications all the same.
    """

    MAX = 2.0

    def __init__(self, per_minute: float, workers: int = 1) -> None:
        self._rate, self._at_once = per_minute / 60.0, max(1, workers - 1)
        self._level, self._at, self._running = (self.MAX if per_minute else 0.0), 0.0, 0

    def refill(self, now: float) -> bool:
        """Refill up to `now` (s, monotonic); returns whether a verification may be started."""
        passed, self._at = (max(0.0, now - self._at) if self._at else 0.0), now
        self._level = min(self.MAX, self._level + self._rate * passed)
        return self._level >= 1.0 and self._running < self._at_once

    def take(self) -> None:
        """Count a verification that was started."""
        self._level -= 1.0
        self._running += 1

    def ended(self) -> None:
        """Count a verification that is over."""
        self._running -= 1


class WorkPace:
    """Mean time of the work for one servo, and what follows from it.

    Parameters
    ----------
    share : float
        Largest share of one worker's time for one servo.
    """

    def __init__(self, share: float = 1.0) -> None:
        self._share, self.seconds = share, 0.0

    def note(self, seconds: float) -> None:
        """Note the time that a servo took."""
        self.seconds += (_FORGETTING if self.seconds else 1.0) * (seconds - self.seconds)

    @property
    def servos(self) -> int:
        """Number of servos that a job may have."""
        return _SERVOS if self.seconds * _SERVOS <= _JOB_S else max(1, int(_JOB_S / self.seconds))

    def hold(self, seconds: float) -> float:
        """s for which a servo that took so long waits for its next turn."""
        hold = seconds * (1.0 / self._share - 1.0)
        return hold if hold >= _SHORTEST_HOLD_S else 0.0


class EstimateShare:
    """Turns of deferred estimates among the work on new messages."""

    def __init__(self) -> None:
        self._owed = 0.0

    @property
    def due(self) -> bool:
        """An estimate is to come before new messages."""
        return self._owed > 0.0

    def note(self, seconds: float, estimate: bool) -> None:
        """Note the time of some work."""
        owed = self._owed + seconds * (_ESTIMATES - 1.0 if estimate else _ESTIMATES)
        self._owed = min(max(owed, -_MOST_OWED_S), _MOST_OWED_S)
