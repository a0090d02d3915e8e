"""The newest update on its way: repeated until the edge has decided, then given up."""

from __future__ import annotations

import math
from dataclasses import dataclass

from servotwin.messages import Update
from servotwin.twin.versions import Versions


@dataclass
class Delivery:
    """When the pending update of `versions` goes out.

    Attributes
    ----------
    retry : float
        s without a receipt after which it is sent again.
    most : int
        How often it is sent before it is given up.
    sent_at : float
        s, when it was sent last.
    attempts : int
        How often it was sent.
    """

    retry: float
    most: int
    sent_at: float = -math.inf
    attempts: int = 0

    def first(self, versions: Versions, now: float) -> list[Update]:
        """A new one."""
        self.attempts = 0
        return self._again(versions, now)

    def next_wake(self, versions: Versions) -> float | None:
        """When `wake` is due, s; None: nothing is waited for."""
        return None if versions.pending is None else self.sent_at + self.retry

    def wake(self, versions: Versions, now: float) -> list[Update]:
        """The pending one once more when its receipt is overdue."""
        due = self.next_wake(versions)
        if due is None or now < due:
            return []
        if self.attempts >= self.most:
            versions.give_up()
        return self._again(versions, now)

    def steady(self, now: float) -> None:
        """Nothing happened later than `now` (s), whatever the clock said then."""
        self.sent_at = min(self.sent_at, now)

    def _again(self, versions: Versions, now: float) -> list[Update]:
        if versions.pending is None:
            return []
        self.sent_at, self.attempts = now, self.attempts + 1
        return [versions.pending]
