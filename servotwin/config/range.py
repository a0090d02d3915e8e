"""The numbers that a key accepts, and the words for them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Range:
    """The numbers that a key accepts: `minimum` and `maximum` belong to it, `above` and `below` do not."""

    minimum: float = -math.inf
    maximum: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    infinite: bool = False

    def accepts(self, value: float) -> bool:
        """True where a number lies in the range; NaN never does, an infinite one only where `infinite`."""
        if not (isinstance(value, int) or math.isfinite(value) or (self.infinite and not math.isnan(value))):
            return False
        if (self.above > -math.inf and value <= self.above) or (self.below < math.inf and value >= self.below):
            return False
        return self.minimum <= value <= self.maximum

    def scaled(self, scale: Callable[[float], float]) -> Range:
        """The same range in another unit."""
        ends = (self.minimum, self.maximum, self.above, self.below)
        minimum, maximum, above, below = (scale(end) if math.isfinite(end) else end for end in ends)
        return Range(minimum, maximum, above, below, self.infinite)

    @property
    def whole(self) -> str:
        """The words for integers."""
        words = str(self).removesuffix(", finite")
        return words.replace("a number", "an integer").replace("a positive number", "a positive integer")

    def __str__(self) -> str:
        words = ["a positive number" if self.above == 0.0 else "a number"]
        if self.minimum > -math.inf:
            words.append(f"at least {self.minimum:g}")
        if self.above > -math.inf and self.above != 0.0:
            words.append(f"above {self.above:g}")
        if self.maximum < math.inf:
            words.append(f"at most {self.maximum:g}")
        if self.below < math.inf:
            words.append(f"below {self.below:g}")
        words.append("inf allowed" if self.infinite else "finite")
        return ", ".join(words)
