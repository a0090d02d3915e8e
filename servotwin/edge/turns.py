"""Turning points of a signal, and whether they are those of a sustained oscillation."""

from collections import deque
from itertools import accumulate, pairwise


class Turns:
    """Finds turns by their size: a turn is one when the signal has come back from it by more than `reversal`.

    Parameters
    ----------
    reversal : float
        In the signal's unit.
    swings : int
        Swings, from turn to turn, that are kept.
    """

    def __init__(self, reversal: float, swings: int) -> None:
        self._reversal, self._swings = reversal, swings
        self._points: deque[tuple[int, float]] = deque(maxlen=swings + 1)
        self._found = 0
        self._place, self._direction = 0, 1.0
        self._extreme: tuple[int, float] | None = None

    def add(self, value: float) -> bool:
        """Take the next value; whether it confirms a turn."""
        self._place += 1
        if self._extreme is None or self._direction * (value - self._extreme[1]) >= 0.0:
            self._extreme = self._place, value
            return False
        if abs(value - self._extreme[1]) <= self._reversal:
            return False
        self._points.append(self._extreme)
        self._found += 1
        self._direction, self._extreme = -self._direction, (self._place, value)
        return True

    def sustained(self, smallest: float, similarity: float) -> float | None:
        """Amplitude (half of the last swing) of an oscillation that does not die out; None: there is none.

        Parameters
        ----------
        smallest : float
            Amplitude that every swing reaches.
        similarity : float
            Factor by which a swing may be smaller than one before it, and half a period differ from another.
        """
        if self._found < self._swings + 2:  # the first point is where the record began, no turn
            return None
        pairs = list(pairwise(self._points))
        sizes = [abs(after[1] - before[1]) for before, after in pairs]
        times = [after[0] - before[0] for before, after in pairs]
        lasting = all(size * similarity >= largest for size, largest in zip(sizes, accumulate(sizes, max), strict=True))
        regular = max(times) <= similarity * min(times)
        return 0.5 * sizes[-1] if lasting and regular and min(sizes) >= 2.0 * smallest else None
