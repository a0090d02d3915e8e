"""Log lines on results that could not be committed: the same work fails again every second."""

from __future__ import annotations

import logging
import math

log = logging.getLogger(__name__)

_AGAIN_S = 60.0
"""s between two lines while results cannot be committed."""


class UncommittedResults:
    """Results that could not be committed.

    A line tells the first one, one a minute their number, and one that results are committed again. Where some are and
    some are not, as on a disk that is almost full, these are the lines of a minute.
    """

    def __init__(self) -> None:
        self._number, self._logged_at, self._told = 0, -math.inf, False

    def failed(self, now: float, servo: str, why: str) -> None:
        """Count a result that could not be committed at a time, monotonic s."""
        self._number += 1
        if now - self._logged_at >= _AGAIN_S:
            self._logged_at, self._told = now, True
            log.error("result not committed", extra={"servo": servo, "why": why, "number": self._number})

    def over(self) -> None:
        """Note that a result was committed."""
        if self._told:
            log.info("results committed again", extra={"number": self._number})
            self._number, self._told = 0, False
