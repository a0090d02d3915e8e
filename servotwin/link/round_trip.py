"""Time after which a request without an answer is sent again, from the round trips before it (RFC 6298)."""

from __future__ import annotations

from dataclasses import dataclass

SHORTEST_S = 1.0
"""s; below it a twin that is only slow at its commits would get its requests twice."""


@dataclass(slots=True)
class RoundTrip:
    """Estimate of the round trip, and the wait that follows from it.

    Parameters
    ----------
    longest_s : float
        Ceiling of the wait, s.

    Attributes
    ----------
    wait_s : float
        Time to wait for an answer before the request is sent again, s.
    """

    longest_s: float
    wait_s: float = SHORTEST_S
    _mean: float | None = None
    _deviation: float = 0.0

    def __post_init__(self) -> None:
        self._wait(self.wait_s)

    def answered(self, seconds: float) -> None:
        """Take in a measured round trip."""
        if self._mean is None:
            self._mean, self._deviation = seconds, seconds / 2.0
        else:
            self._deviation += (abs(seconds - self._mean) - self._deviation) / 4.0
            self._mean += (seconds - self._mean) / 8.0
        self._wait(self._mean + 4.0 * self._deviation)

    def _wait(self, seconds: float) -> None:
        self.wait_s = min(max(seconds, SHORTEST_S), self.longest_s)
