"""A probing move of the reference: how large it may be, and the one under way."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.messages import Probe


@settings("probe")
@dataclass(frozen=True, slots=True)
class ProbeLimits:
    """Probing moves that an edge makes."""

    size: Annotated[float, key("size_mm", "size_m", above=0.0, help="Largest move, either way.")]
    interval_s: Annotated[float, key(minimum=0.0, help="Shortest time from the beginning of one to the next.")] = 60.0
    rest_s: Annotated[float, key(above=0.0, help="Time for which the reference must have rested before one.")] = 1.0

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class ProbingMove:
    """Offset added to the reference: `size` for `hold` samples, 0 for as many, `strokes` times.

    Parameters
    ----------
    first : int
        First sample of it.
    size : float
        m.
    hold, strokes : int
    """

    first: int
    size: float
    hold: int
    strokes: int

    @classmethod
    def of(cls, asked: Probe, first: int, rate: float) -> "ProbingMove":
        """From a sample on, at `rate` Hz."""
        return cls(first, asked.size, max(1, round(asked.hold_s * rate)), asked.strokes)

    @property
    def last(self) -> int:
        """First sample after it."""
        return self.first + 2 * self.strokes * self.hold

    def offset(self, sample: int) -> float:
        """m, at a sample."""
        if not self.first <= sample < self.last:
            return 0.0
        return 0.0 if (sample - self.first) // self.hold % 2 else self.size

    def changes(self) -> Iterator[tuple[int, float]]:
        """Samples from which on the offset is another, with the offset."""
        for sample in range(self.first, self.last, self.hold):
            yield sample, self.offset(sample)

    def next_change(self, sample: int) -> int:
        """The first change after a sample, or the end."""
        return min(self.last, self.first + ((sample - self.first) // self.hold + 1) * self.hold)
