"""Pacing of a machine by the clock, whose time (s) comes from outside."""

import math


class Pace:
    """Samples at `speed` times real time; what is late is caught up, as far as `slack`, the rest is given up.

    Parameters
    ----------
    rate : float
        Hz, samples per second of machine time.
    speed : float
        Seconds of machine time per second.
    slack : float
        s by the clock.
    now : float
        When sample `first` is due, s.
    first : int
    """

    def __init__(self, rate: float, speed: float, slack: float, now: float, first: int = 0) -> None:
        self._rate, self._slack = rate, slack
        self._every, self._speed = 1.0 / (rate * speed), speed
        self._zero = now - first * self._every

    def change(self, speed: float, now: float) -> None:
        """Another speed from now on."""
        passed = (now - self._zero) / self._every
        self._every, self._speed = 1.0 / (self._rate * speed), speed
        self._zero = now - passed * self._every

    def due(self, number: int) -> float:
        """Time at which a sample is due, s."""
        return self._zero + number * self._every

    def reached(self, now: float) -> int:
        """The last sample that is due."""
        return math.floor((now - self._zero) / self._every)

    def keep(self, number: int, now: float) -> float:
        """Machine time (s) by which a sample taken now is late; time beyond the slack is given up."""
        late = now - self.due(number)
        if late > self._slack:
            self._zero += late - self._slack
            late = self._slack
        return max(late, 0.0) * self._speed
