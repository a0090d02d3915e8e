"""What the filter across windows assumes of wear."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from servotwin.errors import InvalidInput
from servotwin.estimation.settings_check import check_number


@dataclass(frozen=True)
class TrendSettings:
    """What is assumed of wear before anything was measured. `for_wear` derives all of it from two plain numbers.

    Parameters
    ----------
    gap_std_rad, rate_std_rad_per_s, offset_std_rad : float
        Spread, around zero, of the total gap, its rate and the encoder's offset before the first window.
    gap_walk_rad_per_sqrt_s : float
        Random walk of the gap itself, on top of its rate.
    rate_walk_rad_per_s_per_sqrt_s : float
        Random walk of the rate: how fast wear may change its pace.
    offset_walk_rad_per_sqrt_s : float
    shared_error_rad : float
        Error that all windows have in common (the model's), which no number of windows averages away; it widens the
        stated gap, not its rate.
    outlier_std : float
        An estimate farther from the prediction than so many standard deviations is refused.
    restart_after : int
        So many outliers in a row that agree with each other mean that the machine has changed (a crash, a new or
        re-adjusted screw): the gap then starts afresh from them.
    agreement_std : float
        Outliers agree when each is within so many standard deviations of what the ones before it predict.

    Raises
    ------
    InvalidInput
        A value is negative or not finite, or `restart_after` is not a whole number of at least 1.
    """

    gap_std_rad: float = math.radians(60.0)
    rate_std_rad_per_s: float = math.radians(0.2)
    offset_std_rad: float = math.radians(60.0)
    gap_walk_rad_per_sqrt_s: float = 0.0
    rate_walk_rad_per_s_per_sqrt_s: float = math.radians(0.015)
    offset_walk_rad_per_sqrt_s: float = 0.0
    shared_error_rad: float = math.radians(0.02)
    outlier_std: float = 6.0
    restart_after: int = 2
    agreement_std: float = 3.0

    def __post_init__(self) -> None:
        for item in fields(self):
            check_number(f"trend {item.name}", getattr(self, item.name))
        if not isinstance(self.restart_after, int) or self.restart_after < 1:
            raise InvalidInput(f"trend restart_after = {self.restart_after!r}: must be a whole number of at least 1")

    @classmethod
    def for_wear(cls, gap: float, over: float, **changes: float) -> TrendSettings:
        """Settings for a gap that grows by about `gap` (rad) within `over` (s), at a pace that may change meanwhile.

        The rate begins with a spread of gap / over and wanders by as much within `over`.
        """
        if not (0.0 < gap < math.inf and 0.0 < over < math.inf):
            raise InvalidInput(f"wear of {gap!r} rad over {over!r} s: both must be finite and greater than 0")
        rate = gap / over
        known = {"rate_std_rad_per_s": rate, "rate_walk_rad_per_s_per_sqrt_s": rate / math.sqrt(over)}
        return cls(**{**known, **changes})  # type: ignore[arg-type]
