"""Token bucket: something may happen some times at once, and at a steady rate later on. No clock of its own."""

from __future__ import annotations

from collections.abc import Callable


class TokenBucket:
    """A bucket that begins full.

    Parameters
    ----------
    most, rate : float
        Tokens that it holds, and that are added per s.
    monotonic : callable
        s.
    """

    def __init__(self, most: float, rate: float, monotonic: Callable[[], float]) -> None:
        self._most, self._rate, self._now = most, rate, monotonic
        self._level, self._at = most, monotonic()

    def take(self) -> bool:
        """Take a token; False: there is none."""
        now = self._now()
        self._level, self._at = min(self._most, self._level + self._rate * (now - self._at)), now
        taken = self._level >= 1.0
        self._level -= taken
        return taken
