"""Test of the share of machines that settles: a first sample, and a larger one where the first leaves it open.

A setting that settles on 998 of 1000 machines fails on one of 300 in nearly half of all samples. So a first sample with
a few failures is no refusal yet: the sample grows, to a size at which both stages together accept a setting whose share
is too small as rarely as is demanded.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property

from servotwin.errors import InvalidInput

# Largest second sample, in first ones; halvings that tell a share to rounding.
_LONGEST, _BISECTIONS = 5, 60


@dataclass(frozen=True)
class SettlingTest:
    """Test that a share of all machines settles at least.

    Parameters
    ----------
    share, confidence : float
        Within 0 .. 1: a setting that settles on less than the share of all machines passes with a probability of at
        most 1 - confidence.
    first : int
        Machines of the first stage.
    more : int
        Failures that both stages together accept, beyond those that the first one does; 0: there is no second stage.
    """

    share: float
    confidence: float
    first: int
    more: int = 3

    @cached_property
    def allowed_first(self) -> int:
        """Failures with which the first stage passes; -1: the sample is too small for any pass."""
        failures = -1
        while share_at_least(self.first - failures - 1, self.first, self.confidence) >= self.share:
            failures += 1
            if failures == self.first:
                break
        return failures

    @cached_property
    def whole(self) -> int:
        """Machines of both stages; those of the first where none is large enough."""
        if self.allowed_first < 0 or not self.more:
            return self.first
        most, sizes = self.allowed_first + self.more, range(self.first + 1, _LONGEST * self.first + 1)
        rare = 1.0 - self.confidence
        place = bisect_left(sizes, True, key=lambda machines: self._passing(self.share, most, machines) <= rare)
        return sizes[place] if place < len(sizes) else self.first

    @property
    def allowed(self) -> int:
        """Failures with which the second stage passes, or the first where there is no second."""
        return self.allowed_first + (self.more if self.whole > self.first else 0)

    def is_refused(self, failures: int) -> bool:
        """True where no further machines can make a setting pass."""
        return failures > max(self.allowed, 0)

    def is_open(self, failures: int) -> bool:
        """True where the first stage neither passes nor refuses."""
        return self.allowed_first < failures <= self.allowed and self.whole > self.first

    def at_least(self, failures: int, machines: int) -> float:
        """Lower bound of the share that settles, at the test's confidence.

        Where the second stage passes it counts that the first did not: it is the share with which so good a result, or
        a pass of the first stage, has the probability 1 - confidence.

        Raises
        ------
        InvalidInput
            The numbers are no sample.
        """
        if machines != self.whole or not self.is_open(failures):
            return share_at_least(machines - failures, machines, self.confidence)
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            rare = self._passing(middle, failures, machines) <= 1.0 - self.confidence
            low, high = (middle, high) if rare else (low, middle)
        return low

    def _passing(self, share: float, failures: int, machines: int) -> float:
        """Probability that a setting with this share passes the first stage, or fails at most so often in both."""
        missing, first = 1.0 - share, self.allowed_first
        passed = _at_most(first, self.first, missing)
        for count in range(first + 1, failures + 1):
            exactly = _at_most(count, self.first, missing) - _at_most(count - 1, self.first, missing)
            passed += exactly * _at_most(failures - count, machines - self.first, missing)
        return passed


def _at_most(failures: int, trials: int, probability: float) -> float:
    """Probability of at most so many failures."""
    from scipy.special import bdtr

    return float(bdtr(failures, trials, probability)) if 0 <= failures < trials else float(failures >= trials)


def share_at_least(successes: int, trials: int, confidence: float) -> float:
    """Lower bound of a share (Clopper-Pearson): with that confidence at least so much of all succeeds.

    Parameters
    ----------
    successes, trials : int
        Of independent trials.
    confidence : float
        Within 0 .. 1.

    Raises
    ------
    InvalidInput
        The numbers are no sample.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise InvalidInput(f"{successes} successes in {trials} trials: must be 0 to all of at least 1")
    if successes == 0:
        return 0.0
    from scipy.special import betaincinv

    # The quantile of a beta distribution; without a failure it is (1 - confidence)^(1 / trials).
    return float(betaincinv(successes, trials - successes + 1, 1.0 - confidence))
