"""Retries with pauses that grow from one failure to the next (exponential backoff with jitter)."""

from dataclasses import dataclass, field
from typing import Annotated

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import check, key, settings


@settings("retry")
@dataclass(frozen=True, slots=True)
class Retry:
    """Pauses between tries: `first_s`, then each `factor` times the last, up to `longest_s`.

    `first_s` should exceed the round trip: otherwise each message is sent again before its answer can arrive.
    """

    first_s: Annotated[float, key(above=0.0, help="First pause, longer than a round trip.")] = 5.0
    factor: Annotated[float, key(minimum=1.0, help="Factor from one pause to the next.")] = 2.0
    longest_s: Annotated[float, key(above=0.0, help="Longest pause, at least the first.")] = 60.0

    def __post_init__(self) -> None:
        check(self)
        if not self.first_s <= self.longest_s:
            raise contradiction(self, "{0}: must be at most {1}", "first_s", "longest_s")


@dataclass(slots=True)
class Backoff:
    """Failures in a row, and the pause after each.

    Parameters
    ----------
    retry : Retry
    failures : int
        In a row, so far.
    """

    retry: Retry = field(default_factory=Retry)
    failures: int = 0

    def failed(self, chance: float = 1.0) -> float:
        """Count a failure and return the pause after it, s.

        Parameters
        ----------
        chance : float
            Uniform in 0 .. 1: the pause is between half of its length (0) and the whole (1), so that many clients do
            not return all at once.
        """
        pause = self.retry.first_s
        for _ in range(min(self.failures, 64)):  # a power would overflow after days of failures
            pause = min(pause * self.retry.factor, self.retry.longest_s)
        self.failures += 1
        return pause * (0.5 + 0.5 * chance)

    def succeeded(self) -> None:
        """Reset: the next failure is followed by the first pause."""
        self.failures = 0
