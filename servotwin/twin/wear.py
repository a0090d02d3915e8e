"""Wear of one servo from window to window, on the edge's clock of sample time. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.trend import Trend, TrendSettings


@dataclass(frozen=True)
class Expectation:
    """Knowledge about the gap before a window is estimated.

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
        """Start of an estimator: the prediction, or the previous gap while there is none."""
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
        """Upper bound of the gap, rad; inf where nothing is known."""
        return math.inf if self.trend is None else self.trend.gap_interval[1]

    def gap_rate(self, settings: TrendSettings) -> float:
        """Root mean square of the growth to reckon with inside the window, rad/s.

        Without it a growing gap is taken for a wrong model, and its value is that of whenever the screw crossed it: of
        Fig 16's windows one in three was refused, and in the calm loop estimates were off by up to 0.04 deg.
        """
        rate, std = (0.0, settings.rate_std_rad_per_s) if self.trend is None else (self.trend.rate, self.trend.rate_std)
        return math.hypot(rate, std)


class TrendState(Struct, frozen=True):
    """A `Trend` as plain numbers, without its settings; `covariance` row by row."""

    time: float
    mean: Annotated[tuple[float, ...], Meta(min_length=3, max_length=3)]
    covariance: Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)]
    updates: int
    refused: int
    reasons: tuple[str, ...]
    rival: TrendState | None

    @classmethod
    def of(cls, trend: Trend) -> TrendState:
        """The numbers of a trend."""
        return cls(
            time=float(trend.time),
            mean=tuple(trend.mean.tolist()),
            covariance=tuple(trend.covariance.ravel().tolist()),
            updates=trend.updates,
            refused=trend.refused,
            reasons=trend.reasons,
            rival=None if trend.rival is None else cls.of(trend.rival),
        )

    def trend(self, settings: TrendSettings) -> Trend:
        """The trend, bit for bit."""
        return Trend(
            time=self.time,
            mean=np.array(self.mean),
            covariance=np.array(self.covariance).reshape(3, 3),
            settings=settings,
            updates=self.updates,
            refused=self.refused,
            reasons=self.reasons,
            rival=None if self.rival is None else self.rival.trend(settings),
        )


class Wear(Struct, frozen=True):
    """The trend of one servo, moved by accepted estimates in the order of their windows.

    Sample time begins anew with each boot of the edge. The time between two boots is taken from the twin's own clock.
    The encoder's offset is forgotten then, as the encoder may be homed elsewhere.

    Attributes
    ----------
    previous : float
        rad, gap of the last accepted estimate; before, the gap believed at the start.
    boot, arrived : str, float
        Of the last window that moved the trend; s, on the twin's clock.
    state : TrendState or None
        None before the first estimate.
    """

    previous: float
    boot: str = ""
    arrived: float = 0.0
    state: TrendState | None = None

    def trend(self, settings: TrendSettings) -> Trend | None:
        """The trend as the last estimate left it."""
        return None if self.state is None else self.state.trend(settings)

    def expect(self, settings: TrendSettings, boot: str, time: float, now: float) -> Expectation:
        """Expectation of a window of `boot` with its middle at `time` (s) that arrived at `now`.

        For a window older than the trend, it is the trend as it stands.
        """
        trend = self._on_clock(settings, boot, time, now)
        return Expectation(self.previous, trend and trend.predict(max(time, trend.time)))

    def update(self, settings: TrendSettings, boot: str, estimate: GapEstimate, now: float) -> tuple[Wear, str]:
        """The wear after an estimate, and why no parameters may stand on that; empty where they may.

        An estimate that is not OK, or older than the trend, changes nothing. An outlier leaves the prediction, with the
        reason in the trend's `reasons`, until others agree with it.
        """
        if not estimate.ok:
            return self, f"the estimate is {estimate.status.value}: {'; '.join(estimate.reasons) or 'no reason given'}"
        trend = self._on_clock(settings, boot, estimate.time, now)
        if self.state is not None and trend is not None and estimate.time <= trend.time:
            return self, "; ".join(self.state.reasons) or "the window is older than the trend"
        after = (trend or Trend.start(estimate.time, settings)).update(estimate)
        counts = after.refused == 0
        previous = float(estimate.gap) if counts else self.previous
        rejection = "" if counts else "; ".join(after.reasons) or "the window is older than the trend"
        return Wear(previous, boot, now, TrendState.of(after)), rejection

    def _on_clock(self, settings: TrendSettings, boot: str, time: float, now: float) -> Trend | None:
        """The trend on the clock of `boot`."""
        trend = self.trend(settings)
        if trend is None or boot == self.boot:
            return trend
        return trend.without_offset().on_clock(time - max(0.0, now - self.arrived))
