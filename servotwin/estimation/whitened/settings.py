"""Settings of the whitened estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import check, key, settings, value

_LARGEST_SKEW = 5e-3  # s of the paper's servo
_WIDE = math.radians(60.0)  # of the motor: gaps of the paper's servo are narrower


@settings("estimator")
@dataclass(frozen=True)
class WhitenedSettings:
    """Settings of the whitened estimator.

    Leave `skew` on unless one clock samples both channels: a delay of a fifth of a millisecond, not accounted for, is
    0.4 deg. Off, the spread falls by a fifth. With a `gap_rate` the gap's rate within the window is estimated beside
    the gap, counts in `std`, and the estimate is that of the gap in the middle of the window.
    """

    passes: Annotated[
        int, key(minimum=1, help="Number of fits; each uses the noise model from the residual of the previous one.")
    ] = 4
    order: Annotated[
        int, key(minimum=1, help="Largest order of the noise's autoregression, at the decimated rate.")
    ] = 60
    starts: Annotated[
        int, key(minimum=1, help="Number of gaps of the first search, from zero to the motor's range.")
    ] = 13
    refined: Annotated[
        int,
        key(
            "refined",
            "kept",
            minimum=1,
            help="Number of minima of the first search, at a low rate, that are refined at the full rate.",
        ),
    ] = 4
    skew: Annotated[bool, key(help="Estimate a delay between the channels.")] = True
    largest_skew: Annotated[
        float | None,
        key(
            "largest_skew_s",
            minimum=0.0,
            help="Largest delay between the channels that is accepted; where absent 5 ms on the paper's servo and as "
            "much of its own time on another.",
        ),
    ] = None
    gap_rate: Annotated[
        float,
        key(
            "gap_rate_deg_per_s",
            minimum=0.0,
            help="Standard deviation of the gap's rate of growth within the window; 0: the gap is constant.",
        ),
    ] = 0.0
    offset: Annotated[
        tuple[float, float] | None,
        key(
            "offset_deg",
            help="Expected encoder offset, position / (p static gain) less screw angle, and its standard deviation, "
            "from earlier windows; with it one contact can be enough.",
        ),
    ] = None
    prefilter_hz: Annotated[
        float | None,
        key(
            minimum=0.0,
            help="Cut-off of the zero-phase low-pass on theta_m; 0: none; where absent it follows from the encoder's "
            "noise.",
        ),
    ] = None
    contact_travel: Annotated[
        float | None,
        key(
            "contact_travel_deg",
            minimum=0.0,
            help="Least travel of the fitted screw in each contact; where absent 0.5 deg, or, where the servo states "
            "the encoder's resolution, a third of the gap and at least 100 counts, if that is less.",
        ),
    ] = None
    largest_std: Annotated[
        float,
        key(
            "largest_std_deg",
            above=0.0,
            help="Largest statistical standard deviation of an estimate that is accepted, of gaps beyond 60 deg in "
            "proportion more; in noise whose spectrum the window itself must show down to three fifths of that.",
        ),
    ] = math.radians(0.05)
    largest_shift: Annotated[
        float,
        key(
            "largest_shift_deg",
            minimum=0.0,
            help="Where free stiffness, damping, pitch and compliance of the screw would move the gap by more, the "
            "model does not fit the window. Of gaps beyond 60 deg in proportion more.",
        ),
    ] = math.radians(0.05)
    model_error: Annotated[
        float,
        key("model_error_deg", minimum=0.0, help="Standard deviation of unmodelled effects, part of std_total."),
    ] = math.radians(0.02)
    calibration: Annotated[
        float,
        key(
            above=0.0,
            help="Reported over computed standard deviation, so that the 95 % interval holds 95 % (docs/estimator.md).",
        ),
    ] = 1.1
    combine: Annotated[
        bool,
        value(
            help="Merge an OK estimate with a prior estimate by their std_total. Not for a filter across windows: its "
            "own prediction would then be counted twice."
        ),
    ] = False

    @property
    def skew_limit(self) -> float:
        """Largest delay between the channels that is accepted, s."""
        return _LARGEST_SKEW if self.largest_skew is None else self.largest_skew

    def of_gap(self, gap: float) -> WhitenedSettings:
        """The settings for a gap (rad): the angles that are allowed grow with gaps that are wide."""
        factor = gap / _WIDE
        if not 1.0 < factor < math.inf:
            return self
        return replace(self, largest_std=factor * self.largest_std, largest_shift=factor * self.largest_shift)

    def on(self, second: float) -> WhitenedSettings:
        """The settings for a servo whose own second (`plant.scales`) is so many seconds."""
        return replace(self, largest_skew=_LARGEST_SKEW * second) if self.largest_skew is None else self

    def __post_init__(self) -> None:
        check(self)
        if self.offset is not None and not self.offset[1] > 0.0:
            raise contradiction(self, "{0}: must be (mean, standard deviation), the latter above 0", "offset")
