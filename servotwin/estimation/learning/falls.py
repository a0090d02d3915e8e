"""A gap that falls from one window to the next, which no wear does; and one that falls and rises by turns. Pure."""

from __future__ import annotations

import math

from msgspec import Struct
from msgspec.structs import replace

from servotwin.estimation.estimate import GapEstimate

_BACK = 0.5  # of a fall: a gap that rises by so much within one window is back; one that wears takes longer


class Falls(Struct, frozen=True):
    """The last gap, and the fall before it that is not over yet.

    Attributes
    ----------
    gap, std : float
        rad, of the last window that showed it.
    fallen : float
        rad, size of the last fall; 0: it is over.
    left : int
        Windows in a row without a fall or a rise that are missing until it is.
    risen : bool
        True where the gap has come back since.
    by_turns : bool
        True where it has then fallen again.
    """

    gap: float
    std: float
    fallen: float = 0.0
    left: int = 0
    risen: bool = False
    by_turns: bool = False

    def after(self, estimate: GapEstimate, shared: float, sure: float, enough: int) -> Falls:
        """The gap and its falls after another window.

        Parameters
        ----------
        estimate : GapEstimate
            Accepted by its window, and no outlier of the trend.
        shared : float
            rad, error that all windows share, at least.
        sure : float
            Standard deviations by which a gap that has fallen surely has.
        enough : int
            Windows in a row without a fall that end one.
        """
        seen = Falls(float(estimate.gap), float(estimate.std_total))
        change, limit = seen.gap - self.gap, sure * math.hypot(self.std, seen.std, shared)
        if change < -limit:
            by_turns = self.by_turns or self.risen
            return replace(seen, fallen=-change, left=enough, by_turns=by_turns)
        risen = change > max(limit, _BACK * self.fallen)
        left = enough if risen else self.left - 1
        if self.fallen == 0.0 or left <= 0:
            return seen
        return replace(seen, fallen=self.fallen, left=left, risen=self.risen or risen, by_turns=self.by_turns)
