"""Probing moves of the reference: their limits, and the one under way."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.messages import Probe


@settings("probe")
@dataclass(frozen=True, slots=True)
class ProbeLimits:
    """Limits of the probing moves that an edge makes."""

    size: Annotated[
        float, key("size_mm", "size_m", "size_deg", "size_rad", above=0.0, help="Largest move, either way.")
    ]
    interval_s: Annotated[float, key(minimum=0.0, help="Shortest time from the beginning of one to the next.")] = 60.0
    rest_s: Annotated[float, key(above=0.0, help="Time for which the reference must have rested before one.")] = 1.0

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class ProbingMove:
    """Offsets added to the reference, each for `hold` samples.

    Parameters
    ----------
    first : int
        First sample of the move.
    offsets : tuple of float
        m.
    hold : int
        Samples at each offset.
    reason : str
        Reason of its window.
    """

    first: int
    offsets: tuple[float, ...]
    hold: int
    reason: str

    @classmethod
    def of(cls, probe: Probe, first: int, rate: float) -> "ProbingMove":
        """Make the requested move from sample `first` on, at `rate` Hz."""
        offsets = probe.strokes * tuple(share * probe.size for share in probe.places)
        return cls(first, offsets, max(1, round(probe.hold_s * rate)), probe.window_reason)

    @property
    def last(self) -> int:
        """First sample after the move."""
        return self.first + len(self.offsets) * self.hold

    def offset(self, sample: int) -> float:
        """Offset at a sample, m."""
        if not self.first <= sample < self.last:
            return 0.0
        return self.offsets[(sample - self.first) // self.hold]

    def changes(self) -> Iterator[tuple[int, float]]:
        """Yield the samples at which the offset changes, with the new offset (m)."""
        for sample in range(self.first, self.last, self.hold):
            yield sample, self.offset(sample)

    def next_change(self, sample: int) -> int:
        """First change after a sample, or the end of the move."""
        return min(self.last, self.first + ((sample - self.first) // self.hold + 1) * self.hold)
