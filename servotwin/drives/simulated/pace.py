"""Pacing of a simulated machine by the clock, whose time (s) the caller gives."""

import math


class Pace:
    """Schedule of samples at `speed` times real time; a delay up to `slack` is caught up, the rest is skipped.

    Parameters
    ----------
    rate : float
        Hz, samples per second of machine time.
    speed : float
        Seconds of machine time per second.
    slack : float
        Longest delay that is caught up, s by the clock.
    now : float
        Time at which sample `first` is due, s.
    first : int
    """

    def __init__(self, rate: float, speed: float, slack: float, now: float, first: int = 0) -> None:
        self._rate, self._slack = rate, slack
        self._interval, self._speed = 1.0 / (rate * speed), speed
        self._origin = now - first * self._interval

    def change(self, speed: float, now: float) -> None:
        """Change the speed from now on."""
        # The origin moves with the speed, so that the sample that is due now is due now at the new speed too.
        elapsed = (now - self._origin) / self._interval
        self._interval, self._speed = 1.0 / (self._rate * speed), speed
        self._origin = now - elapsed * self._interval

    def due(self, number: int) -> float:
        """Time at which a sample is due, s."""
        return self._origin + number * self._interval

    def reached(self, now: float) -> int:
        """Number of the last sample that is due."""
        return math.floor((now - self._origin) / self._interval)

    def catch_up(self, number: int, now: float) -> float:
        """Shift the schedule by a delay beyond the slack; return the delay of a sample taken now, s of machine time."""
        late = now - self.due(number)
        if late > self._slack:
            self._origin += late - self._slack
            late = self._slack
        return max(late, 0.0) * self._speed
