"""How many proofs may be begun: so many per minute, never many at once."""

from __future__ import annotations


class Allowance:
    """Saved up to two proofs.

    Parameters
    ----------
    per_minute : float
        0: none.
    """

    MOST = 2.0

    def __init__(self, per_minute: float) -> None:
        self._rate = per_minute / 60.0
        self._saved, self._at = (self.MOST if per_minute else 0.0), 0.0

    def may(self, now: float) -> bool:
        """Whether one may be begun, at `now` (s, monotonic)."""
        passed, self._at = (max(0.0, now - self._at) if self._at else 0.0), now
        self._saved = min(self.MOST, self._saved + self._rate * passed)
        return self._saved >= 1.0

    def take(self) -> None:
        """One is begun."""
        self._saved -= 1.0
