"""What a twin knows of its servo's wear from window to window, on the edge's clock of sample time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend, TrendSettings


@dataclass(frozen=True)
class Expectation:
    """What is known before a window is looked at.

    Attributes
    ----------
    previous : float
        rad: the last gap that was accepted, or what was believed at the start.
    trend : Trend or None
        The wear as predicted for the middle of the window; None before the first accepted estimate.
    """

    previous: float
    trend: Trend | None = None

    @property
    def prior(self) -> float | GapEstimate:
        """Where an estimator may start: the prediction, or the previous gap while there is none."""
        return self.previous if self.trend is None else self.trend.as_estimate()

    @property
    def offset(self) -> tuple[float, float] | None:
        """Mean and standard deviation (rad) of the encoder's offset; None while no window of this boot showed it.

        The offset is the middle between two contacts, the gap the distance: of the error that all windows share, which
        does not average away, it has half.
        """
        if self.trend is None or self.trend.prior.offset_std >= self.trend.settings.offset_std_rad:
            return None
        known, shared = self.trend.prior, self.trend.settings.shared_error_rad
        return known.offset, math.hypot(known.offset_std, 0.5 * shared)

    @property
    def widest(self) -> float:
        """rad: the gap is no wider; inf where nothing is known."""
        return math.inf if self.trend is None else self.trend.gap_interval[1]

    def gap_rate(self, settings: TrendSettings) -> float:
        """rad/s: root mean square of the growth to reckon with inside the window.

        Without it a growing gap is taken for a wrong model, and its value is that of whenever the screw crossed it: of
        Fig 16's windows one in three was refused, and in the calm loop estimates were off by up to 0.04 deg.
        """
        rate, std = (0.0, settings.rate_std_rad_per_s) if self.trend is None else (self.trend.rate, self.trend.rate_std)
        return math.hypot(rate, std)


class Wear:
    """The trend of one servo, moved by accepted estimates in the order of their windows.

    Sample time begins anew with each boot of the edge. What passed meanwhile is taken from the twin's own clock. What
    was known of the encoder's offset is forgotten then, as the encoder may be homed elsewhere.

    Parameters
    ----------
    initial_gap : float
        rad, believed before the first estimate.
    settings : TrendSettings
    """

    def __init__(self, initial_gap: float, settings: TrendSettings) -> None:
        self.settings = settings
        self.trend: Trend | None = None
        self.previous = initial_gap
        self.boot, self.heard = "", 0.0

    def expect(self, boot: str, time: float, now: float) -> Expectation:
        """What is known before a window of `boot` with its middle at `time` (s) that arrived at `now`.

        For a window older than the trend, what is known is the trend as it stands.
        """
        trend = self._on_clock(boot, time, now)
        return Expectation(self.previous, trend and trend.predict(max(time, trend.time)))

    def learn(self, boot: str, estimate: GapEstimate, now: float) -> bool:
        """Take an estimate; whether it counts.

        One that is not OK, or older than the trend, changes nothing. An outlier leaves the prediction, with the reason
        in the trend's `reasons`, until others agree with it.
        """
        trend = self._on_clock(boot, estimate.time, now)
        if not estimate.ok or (trend is not None and estimate.time <= trend.time):
            return False
        self.trend = (trend or Trend.start(estimate.time, self.settings)).update(estimate)
        self.boot, self.heard = boot, now
        counts = self.trend.refused == 0
        if counts:
            self.previous = estimate.gap
        return counts

    def refusal(self, boot: str, estimate: GapEstimate, now: float) -> str:
        """Why no parameters may stand on an estimate; empty where they may, and this has learnt from it."""
        if not estimate.ok:
            return f"the estimate is {estimate.status.value}: {'; '.join(estimate.reasons) or 'no reason given'}"
        if self.learn(boot, estimate, now):
            return ""
        return "; ".join(self.trend.reasons if self.trend else ()) or "the window is older than the trend"

    def _on_clock(self, boot: str, time: float, now: float) -> Trend | None:
        """The trend on the clock of `boot`."""
        if self.trend is None or boot == self.boot:
            return self.trend
        return self.trend.without_offset().on_clock(time - max(0.0, now - self.heard))
