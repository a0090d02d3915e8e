"""How far a reference travelled lately: extremes over a sliding time, in a few steps per move."""

from collections import deque
from typing import NamedTuple


class Extreme(NamedTuple):
    """A value (m), and the sample until which it counts."""

    until: int
    value: float


class Moves:
    """What the reference did while the loop may still follow it; moves end in the order in which they were made."""

    def __init__(self) -> None:
        self._until = 0
        self._lows: deque[Extreme] = deque()
        self._highs: deque[Extreme] = deque()

    def __bool__(self) -> bool:
        """Whether the loop may still follow a move."""
        return bool(self._lows)

    @property
    def travel(self) -> float:
        """From the lowest to the highest, m; to be asked for while there is a move."""
        return self._highs[0].value - self._lows[0].value

    def add(self, until: int, low: float, high: float) -> None:
        """A move between two references (m), followed until a sample."""
        self._until = max(until, self._until) if self else until
        while self._lows and self._lows[-1].value >= low:
            self._lows.pop()
        while self._highs and self._highs[-1].value <= high:
            self._highs.pop()
        self._lows.append(Extreme(self._until, low))
        self._highs.append(Extreme(self._until, high))

    def expire(self, sample: int) -> None:
        """Forget what need not be followed any more."""
        for extremes in (self._lows, self._highs):
            while extremes and extremes[0].until <= sample:
                extremes.popleft()
