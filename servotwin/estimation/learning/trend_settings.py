"""Settings of the filter across windows: its assumptions on wear."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from servotwin.config.keys import check, key, settings, value
from servotwin.config.table import Table
from servotwin.errors import InvalidInput


@settings("trend")
@dataclass(frozen=True)
class TrendSettings:
    """Assumptions on wear before the first measurement. `for_wear` derives them from two plain numbers.

    Raises
    ------
    InvalidInput
        A value is negative or not finite, or `restart_after` is not a whole number of at least 1.
    """

    gap_std_rad: Annotated[
        float, value(minimum=0.0, help="Spread of the total gap, around zero, before the first window.")
    ] = math.radians(60.0)
    rate_std_rad_per_s: Annotated[
        float, value(minimum=0.0, help="Spread of its rate, around zero, before the first window.")
    ] = math.radians(0.2)
    offset_std_rad: Annotated[
        float, value(minimum=0.0, help="Spread of the encoder's offset, around zero, before the first window.")
    ] = math.radians(60.0)
    gap_walk_rad_per_sqrt_s: Annotated[
        float, value(minimum=0.0, unit="rad/sqrt(s)", help="Random walk of the gap itself, on top of its rate.")
    ] = 0.0
    rate_walk_rad_per_s_per_sqrt_s: Annotated[
        float,
        value(minimum=0.0, unit="rad/s/sqrt(s)", help="Random walk of the rate: changes of the pace of wear."),
    ] = math.radians(0.015)
    offset_walk_rad_per_sqrt_s: Annotated[
        float, value(minimum=0.0, unit="rad/sqrt(s)", help="Random walk of the encoder's offset.")
    ] = 0.0
    shared_error_rad: Annotated[
        float,
        value(
            minimum=0.0,
            help="Error that all windows share (the model's), which does not average out; it widens the stated gap, "
            "not its rate.",
        ),
    ] = math.radians(0.02)
    shared_error_share: Annotated[
        float,
        value(minimum=0.0, help="The same as a share of the gap, on top of it: of an axis, as its estimator has it."),
    ] = 0.0
    outlier_std: Annotated[
        float,
        value(minimum=0.0, help="An estimate that is farther from the prediction is refused, in standard deviations."),
    ] = 6.0
    restart_after: Annotated[
        int,
        value(
            minimum=1,
            help="Number of consecutive outliers in agreement from which on the machine counts as changed (a crash, a "
            "new or re-adjusted screw): the gap then starts anew from them.",
        ),
    ] = 2
    agreement_std: Annotated[
        float,
        value(
            minimum=0.0,
            help="Outliers agree if each is within this many standard deviations of the earlier ones' prediction.",
        ),
    ] = 3.0

    def __post_init__(self) -> None:
        check(self)

    def shared_error(self, gap: float) -> float:
        """Error (rad) that all windows of a gap (rad) share."""
        return math.hypot(self.shared_error_rad, self.shared_error_share * gap)

    @classmethod
    def on(cls, second: float) -> TrendSettings:
        """Defaults for a servo whose own second (`plant.scales`) is so many seconds: a slow machine wears slowly."""
        rate, walk = math.radians(0.2) / second, math.radians(0.015) / second / math.sqrt(second)
        return cls(rate_std_rad_per_s=rate, rate_walk_rad_per_s_per_sqrt_s=walk)

    @classmethod
    def within(cls, gap: float, horizon: float) -> TrendSettings:
        """Defaults for an axis whose stated gap is at most `gap` (rad), and whose settings hold for `horizon` (s).

        In proportion to the defaults: a range of 60 deg and settings that hold for 40 s.
        """
        size, time = gap / math.radians(60.0), horizon / 40.0
        rate, walk = math.radians(0.2) * size / time, math.radians(0.015) * size / time**1.5
        return cls(
            rate_std_rad_per_s=rate,
            rate_walk_rad_per_s_per_sqrt_s=walk,
            shared_error_rad=math.radians(0.02) * size,
        )

    @classmethod
    def for_wear(cls, gap: float, over: float, **changes: float) -> TrendSettings:
        """Settings for a gap that grows by about `gap` (rad) within `over` (s), at a rate that may change.

        The standard deviation of the rate is gap / over at the start; its random walk reaches as much within `over`.
        """
        if not (0.0 < gap < math.inf and 0.0 < over < math.inf):
            raise InvalidInput(f"wear of {gap!r} rad over {over!r} s: both must be finite and greater than 0")
        rate = gap / over
        known = {"rate_std_rad_per_s": rate, "rate_walk_rad_per_s_per_sqrt_s": rate / math.sqrt(over)}
        return cls(**{**known, **changes})  # type: ignore[arg-type]


def wear(
    gap: Annotated[float, key("wear_deg", above=0.0, at_load=True, help="Expected growth of the gap within over_s.")],
    over: Annotated[float, key("over_s", above=0.0, help="Time in which the gap grows by that.")],
) -> TrendSettings:
    """Make trend settings from the keys of a table."""
    return TrendSettings.for_wear(gap, over)


def trend_maker(table: Table) -> Any:
    """Choose the maker of trend settings: the defaults for an empty table, otherwise `wear`."""
    return wear if table.values else TrendSettings
