"""Settings of the filter across windows: what it assumes of wear."""

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
    """What is assumed of wear before anything was measured. `for_wear` derives all of it from two plain numbers.

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
        value(minimum=0.0, unit="rad/s/sqrt(s)", help="Random walk of the rate: how fast wear may change its pace."),
    ] = math.radians(0.015)
    offset_walk_rad_per_sqrt_s: Annotated[
        float, value(minimum=0.0, unit="rad/sqrt(s)", help="Random walk of the encoder's offset.")
    ] = 0.0
    shared_error_rad: Annotated[
        float,
        value(
            minimum=0.0,
            help="Error that all windows have in common (the model's), which no number of windows averages away; it "
            "widens the stated gap, not its rate.",
        ),
    ] = math.radians(0.02)
    outlier_std: Annotated[
        float,
        value(minimum=0.0, help="An estimate more standard deviations off the prediction is refused."),
    ] = 6.0
    restart_after: Annotated[
        int,
        value(
            minimum=1,
            help="So many outliers in a row that agree mean that the machine has changed (a crash, a new or "
            "re-adjusted screw): the gap then starts afresh from them.",
        ),
    ] = 2
    agreement_std: Annotated[
        float,
        value(
            minimum=0.0,
            help="Outliers agree when each is within so many standard deviations of what the ones before it predict.",
        ),
    ] = 3.0

    def __post_init__(self) -> None:
        check(self)

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


def wear(
    gap: Annotated[float, key("wear_deg", above=0.0, help="Growth of the gap that is expected within over_s.")],
    over: Annotated[float, key("over_s", above=0.0, help="Time in which the gap grows by wear_deg.")],
) -> TrendSettings:
    """Trend settings from a table."""
    return TrendSettings.for_wear(gap, over)


def trend_maker(table: Table) -> Any:
    """What makes trend settings of a table: the defaults of an empty one, otherwise `wear`."""
    return wear if table.values else TrendSettings
