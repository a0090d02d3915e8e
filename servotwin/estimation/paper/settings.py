"""Settings of the paper's estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from servotwin.config.keys import check, key, settings
from servotwin.estimation.paper.zero_phase import PADDINGS

_ORIGINS = ("absolute", "first")
# rad/s, s and rad/s on the paper's servo.
_ALPHA, _SETTLE, _REST_SPEED = 40.0, 0.25, 0.1


class ObserverTimes(NamedTuple):
    """Pole of the observer (1/s, without its sign), time for it to settle (s), speed of a motor at rest (rad/s)."""

    alpha: float
    settle: float
    rest_speed: float


@settings("estimator")
@dataclass(frozen=True)
class PaperSettings:
    """Settings of the paper's estimator.

    With `origin` "absolute", the published reading, the observer starts from zero, so that what lies between zero and
    the window's first position is its initial error. That error biases the gap, the more the farther from zero the
    machine works; with "first" the bias nearly vanishes (tests/estimation/test_paper_loop.py).

    Even `padding` of one period of the cut-off (250 samples at 5 kHz) lowers the scatter in the paper's noise from 0.2
    to 0.05 deg (tests/estimation/test_paper_loop.py). The paper does not name `reversals` and
    `rest_speed` (erratum E14).
    """

    alpha: Annotated[
        float | None,
        key(
            "alpha_rad_per_s",
            above=0.0,
            help="Poles of the observer are at minus this; where absent the paper's 40 rad/s, in the servo's own time.",
        ),
    ] = None
    settle_s: Annotated[
        float | None,
        key(
            minimum=0.0,
            help="Start of a window that the cost ignores, k_s T_s in the paper; where absent the paper's 0.25 s, in "
            "the servo's own time.",
        ),
    ] = None
    lowpass_hz: Annotated[
        float | None,
        key(
            above=0.0,
            help="Cut-off of the zero-phase Butterworth on both channels (20 Hz for noisy windows, section 4.3); no "
            "filter where absent.",
        ),
    ] = None
    lowpass_order: Annotated[
        int,
        key(minimum=1, help="Order of one pass; run forwards and backwards it counts twice (erratum E18)."),
    ] = 10
    padding: Annotated[
        str,
        key(
            choices=PADDINGS,
            help="Extension of a window beyond its ends for the low-pass: turned about its last sample (odd) or "
            "mirrored (even).",
        ),
    ] = "odd"
    padding_samples: Annotated[
        int | None,
        key(
            minimum=0,
            help="Length of that extension in samples; where absent three times the order, as in MATLAB's filtfilt.",
        ),
    ] = None
    iterations: Annotated[int, key(minimum=1, help="Largest number of iterations of the search.")] = 100
    origin: Annotated[str, key(choices=_ORIGINS, help="Origin of angles and positions: zero, or the first sample.")] = (
        "absolute"
    )
    reversals: Annotated[int, key(minimum=0, help="Smallest number of reversals of the motor.")] = 1
    rest_speed: Annotated[
        float | None,
        key(
            "rest_speed_rad_per_s",
            minimum=0.0,
            help="Speed of the motor below which it counts as at rest; where absent 0.1 rad/s on the paper's servo, in "
            "the own time of another.",
        ),
    ] = None
    contact_travel: Annotated[
        float, key("contact_travel_deg", minimum=0.0, help="Least travel of the fitted screw in each contact.")
    ] = math.radians(0.5)
    method_error: Annotated[
        float,
        key(
            "method_error_deg",
            minimum=0.0,
            help="Standard deviation for the method's own bias, part of std_total (measured).",
        ),
    ] = math.radians(0.5)
    largest_std: Annotated[
        float,
        key(
            "largest_std_deg",
            minimum=0.0,
            help="Largest statistical standard deviation of an estimate that is accepted.",
        ),
    ] = math.radians(2.0)
    unexplained: Annotated[
        float,
        key(
            minimum=0.0,
            help="Residual over variation of the position (rms both) above which the model does not fit the window.",
        ),
    ] = 0.5

    def __post_init__(self) -> None:
        check(self)

    def times(self, second: float) -> ObserverTimes:
        """Times and speeds on a servo whose own second (`plant.scales`) is so many seconds."""
        return ObserverTimes(
            _ALPHA / second if self.alpha is None else self.alpha,
            _SETTLE * second if self.settle_s is None else self.settle_s,
            _REST_SPEED / second if self.rest_speed is None else self.rest_speed,
        )
