"""Trend of the gap from window to window: a Kalman filter on the gap, its wear rate and the encoder's offset.

The state is frozen; `predict` and `update` return the next one. Between windows the rate performs a random walk and
the gap integrates it (an integrated Wiener process), the offset performs a random walk of its own. Every window's
estimate corrects the state with its `std_total`; the state gives the next window's prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95, CarriedOffset, GapEstimate, GapStatus, Interval, OffsetReading
from servotwin.estimation.learning.trend_settings import TrendSettings
from servotwin.estimation.passage import Passage, passage
from servotwin.plant.signals import Array
from servotwin.runtime.notebook import html_table

__all__ = ["OffsetReading", "Prior", "Trend", "TrendSettings"]

GAP, RATE, OFFSET = 0, 1, 2


@dataclass(frozen=True, eq=False)
class TrendMeasurement:
    """values (m,) = select (m, 3) state + noise of covariance (m, m)."""

    values: Array
    select: Array
    noise: Array

    @property
    def of_gap(self) -> TrendMeasurement:
        """The measurement of the gap alone."""
        return TrendMeasurement(self.values[:1], self.select[:1], self.noise[:1, :1])


def reading(estimate: GapEstimate, offset: OffsetReading | CarriedOffset | None) -> TrendMeasurement:
    """Turn an OK estimate into a measurement of gap and offset.

    Where the gap rests on the carried offset, the window shows gap - slope * offset only. Taken as a measurement of the
    gap, it would count the offset's error as an independent one in every such window.

    Raises
    ------
    InvalidInput
        The spreads make no covariance matrix.
    """
    variance = estimate.std_total**2
    if not 0.0 <= variance < math.inf:
        raise InvalidInput(f"trend: the estimate's std_total = {estimate.std_total!r} rad: must be finite")
    if offset is None:
        return TrendMeasurement(np.array([estimate.gap]), np.eye(3)[:1], np.array([[variance]]))
    if isinstance(offset, CarriedOffset):
        own = max(0.0, variance - (offset.slope * offset.std) ** 2)
        select = np.array([[1.0, 0.0, -offset.slope]])
        return TrendMeasurement(np.array([estimate.gap - offset.slope * offset.offset]), select, np.array([[own]]))
    noise = np.array([[variance, offset.covariance], [offset.covariance, offset.std**2]])
    if not np.all(np.isfinite(noise)) or np.any(np.linalg.eigvalsh(noise) < 0.0):
        raise InvalidInput(f"trend: {offset} and std_total = {estimate.std_total!r} rad make no covariance matrix")
    return TrendMeasurement(np.array([estimate.gap, offset.offset]), np.eye(3)[[GAP, OFFSET]], noise)


def transition(step: float) -> Array:
    """(3, 3) matrix that carries the state on by `step` seconds."""
    flow = np.eye(3)
    flow[GAP, RATE] = step
    return flow


def process_noise(step: float, settings: TrendSettings) -> Array:
    """(3, 3) covariance that `step` seconds of the random walks add: exact however the time is divided."""
    gap, rate = settings.gap_walk_rad_per_sqrt_s**2, settings.rate_walk_rad_per_s_per_sqrt_s**2
    noise = np.zeros((3, 3))
    noise[GAP, GAP] = gap * step + rate * step**3 / 3.0
    noise[GAP, RATE] = noise[RATE, GAP] = rate * step**2 / 2.0
    noise[RATE, RATE] = rate * step
    noise[OFFSET, OFFSET] = settings.offset_walk_rad_per_sqrt_s**2 * step
    return noise


def _bound_std(estimate: GapEstimate) -> float:
    """Spread (rad) of a lower bound, from the lower end of its 95 % interval."""
    return max(0.0, estimate.gap - estimate.interval[0]) / NORMAL_95


def truncation(margin: float) -> tuple[float, float]:
    """(shift, shrinkage) of a standard normal that is known to exceed -margin: its mean, one less its variance."""
    # Here, because scipy.special takes long to import and many processes estimate nothing.
    from scipy.special import log_ndtr

    if math.isinf(margin):
        return 0.0, 0.0
    pull = math.exp(-0.5 * margin * margin - 0.5 * math.log(2.0 * math.pi) - float(log_ndtr(margin)))
    return pull, min(1.0, max(0.0, pull * (pull + margin)))


_OUTLIER = "the window did not count, being an outlier"
_AFRESH = "outliers in a row that agree"
_MOVED = "the encoder's offset is not what it was: it is read anew from this window"
_DOUBTED = "the gap rested on the encoder's offset, which is forgotten until a window shows it again"


@dataclass(frozen=True)
class Prior:
    """Knowledge before a window: mean and standard deviation of the gap and of the encoder's offset, rad."""

    gap: float
    gap_std: float
    offset: float
    offset_std: float


@dataclass(frozen=True, eq=False, repr=False)
class Trend:
    """Gap, wear rate and encoder offset at a time, with their covariance.

    Attributes
    ----------
    time : float
        s.
    mean : (3,) array
        Total gap (rad), wear rate (rad/s), offset of the encoder (rad).
    covariance : (3, 3) array
        Of `mean`, without the error that all windows share.
    settings : TrendSettings
    updates : int
        Windows that counted.
    refused : int
        Outliers since the last window that counted.
    reasons : tuple of str
        Reasons for which the last window did not count, or counted otherwise than as a plain value.
    rival : Trend or None
        The state that outliers since then would make; it takes over once `restart_after` of them agree.
    """

    time: float
    mean: Array
    covariance: Array
    settings: TrendSettings
    updates: int = 0
    refused: int = 0
    reasons: tuple[str, ...] = ()
    rival: Trend | None = None

    def __repr__(self) -> str:
        """Gap and wear rate with their 95 % intervals in one line."""
        low, high = map(math.degrees, self.gap_interval)
        gap = f"{math.degrees(self.gap):.4g} deg (95 %: {low:.4g} .. {high:.4g} deg)"
        return f"<Trend {gap} at {self.time:.6g} s, {math.degrees(self.rate):.3g} deg/s, {self.updates} windows>"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        low, high = map(math.degrees, self.gap_interval)
        slow, fast = map(math.degrees, self.rate_interval)
        rows = {
            "time": f"{self.time:.6g} s",
            "total gap": f"{math.degrees(self.gap):.4g} deg (95 %: {low:.4g} .. {high:.4g} deg)",
            "wear rate": f"{math.degrees(self.rate):.3g} deg/s (95 %: {slow:.3g} .. {fast:.3g} deg/s)",
            "windows that counted": str(self.updates),
        }
        return html_table("Trend", rows | ({"last window": "; ".join(self.reasons)} if self.reasons else {}))

    @classmethod
    def start(cls, time: float, settings: TrendSettings) -> Trend:
        """Return the state before the first window: zero, as uncertain as the settings say.

        Their defaults are those of the paper's servo: `TrendSettings.on` has them for another one.
        """
        spread = np.array([settings.gap_std_rad, settings.rate_std_rad_per_s, settings.offset_std_rad])
        return cls(_time(time), np.zeros(3), np.diag(spread**2), settings)

    def predict(self, time: float) -> Trend:
        """The state at a later time, s; a gap that would shrink below zero has closed, and stays so.

        Raises
        ------
        InvalidInput
            The time is not finite or lies before the state's.
        """
        step = _time(time) - self.time
        if step < 0.0:
            raise InvalidInput(f"trend: time {time:.9g} s lies before {self.time:.9g} s; windows must come in order")
        flow = transition(step)
        mean = flow @ self.mean
        if mean[GAP] < 0.0 > mean[RATE]:
            mean[[GAP, RATE]] = 0.0
        covariance = flow @ self.covariance @ flow.T + process_noise(step, self.settings)
        rival = self.rival and self.rival.predict(time)
        return replace(self, time=float(time), mean=mean, covariance=covariance, reasons=(), rival=rival)

    def update(self, estimate: GapEstimate, offset: OffsetReading | CarriedOffset | None = None) -> Trend:
        """The state at the estimate's time, corrected by it.

        Only an OK estimate counts as a value. A lower bound counts one-sidedly: it moves the state only as far as the
        state lies below it. Any other status leaves the prediction as it is, with the reason.

        Parameters
        ----------
        estimate : GapEstimate
        offset : OffsetReading or CarriedOffset, optional
            The encoder's offset in the same window; None: the estimate's own.
        """
        ahead = self.predict(estimate.time)
        if estimate.ok:
            measurement = reading(estimate, offset or estimate.offset)
            return ahead._open_to(measurement)._corrected(measurement)
        if estimate.status is GapStatus.LOWER_BOUND and math.isfinite(estimate.gap):
            return ahead._bounded(estimate)
        because = "; ".join(estimate.reasons) or "no reason given"
        return replace(ahead, reasons=(f"the window did not count, being {estimate.status.value}: {because}",))

    def without_offset(self) -> Trend:
        """The same wear with an unknown encoder offset, as after the encoder was homed anew."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[OFFSET] = covariance[OFFSET] = covariance[:, OFFSET] = 0.0
        covariance[OFFSET, OFFSET] = self.settings.offset_std_rad**2
        rival = self.rival and self.rival.without_offset()
        return replace(self, mean=mean, covariance=covariance, rival=rival)

    def on_clock(self, time: float) -> Trend:
        """The same state on a clock that now reads `time`, s."""
        return replace(self, time=_time(time), rival=self.rival and self.rival.on_clock(time))

    def _corrected(self, measurement: TrendMeasurement) -> Trend:
        """Correct the state by a measurement, unless its gap is an outlier; an outlying offset is read anew."""
        # The gap alone first: with the offset included, a slipped encoder would look like a jump of the gap.
        distance = self._distance(measurement.of_gap)
        if distance > self.settings.outlier_std:
            return self._refused(distance, measurement)
        # The gap fits, so it is the offset that does not.
        if self._distance(measurement) > self.settings.outlier_std:
            return replace(self.without_offset()._joseph(measurement), reasons=(_MOVED,))
        return self._joseph(measurement)

    def _open_to(self, measurement: TrendMeasurement) -> Trend:
        """The state, at least as uncertain as a first gap is wide that lies beyond its 95 %.

        A motor behind a gear of a hundred turns has gaps of hundreds of degrees, and no window spoke against them.
        """
        gap = abs(float(measurement.of_gap.values[0]))
        if self.updates > 0 or gap <= NORMAL_95 * math.sqrt(self.covariance[GAP, GAP]):
            return self
        covariance = self.covariance.copy()
        covariance[GAP, GAP] = gap**2
        return replace(self, covariance=covariance)

    def _distance(self, measurement: TrendMeasurement) -> float:
        """Distance from the prediction, in standard deviations of both."""
        surprise = measurement.values - measurement.select @ self.mean
        spread = measurement.select @ self.covariance @ measurement.select.T + measurement.noise
        return math.sqrt(max(0.0, float(surprise @ np.linalg.solve(spread, surprise))))

    def _joseph(self, measurement: TrendMeasurement) -> Trend:
        """Kalman update; Joseph's form keeps the covariance definite."""
        select, noise = measurement.select, measurement.noise
        spread = select @ self.covariance @ select.T + noise
        gain = np.linalg.solve(spread, select @ self.covariance).T
        left = np.eye(3) - gain @ select
        # (I - K H) P alone would lose symmetry and definiteness to rounding after many windows.
        covariance = left @ self.covariance @ left.T + gain @ noise @ gain.T
        mean = self.mean + gain @ (measurement.values - select @ self.mean)
        counted = self.updates + 1
        return replace(self, mean=mean, covariance=_symmetric(covariance), updates=counted, refused=0, rival=None)

    def _refused(self, distance: float, measurement: TrendMeasurement) -> Trend:
        """Count one more outlier; once enough of them agree, start afresh from them."""
        expected = f"{math.degrees(self.mean[GAP]):.4g} deg were expected"
        limit = f"{distance:.3g} standard deviations away, and {self.settings.outlier_std:.3g} are allowed"
        refused = replace(self, refused=self.refused + 1, reasons=(f"{_OUTLIER}: {expected}, {limit}",))
        if _leans_on_offset(measurement):
            return replace(refused.without_offset(), reasons=(*refused.reasons, _DOUBTED))
        rival = self._rival(measurement)
        if rival.updates < self.settings.restart_after:
            return replace(refused, rival=rival)
        reason = f"{_AFRESH}: {rival.updates}; the gap starts afresh, as after a crash or a repair"
        return replace(rival, updates=self.updates + rival.updates, reasons=(reason,))

    def _rival(self, measurement: TrendMeasurement) -> Trend:
        """State that this outlier makes together with the earlier ones that agree with it."""
        if self.rival is not None and self.rival._distance(measurement.of_gap) <= self.settings.agreement_std:
            return self.rival._corrected(measurement)
        start = Trend.start(self.time, self.settings)
        if self.rival is None:
            # The gap has jumped; the wear rate that was learnt stays.
            start.covariance[RATE, RATE] = self.covariance[RATE, RATE]
            start.mean[RATE] = self.mean[RATE]
        return start._open_to(measurement)._joseph(measurement)

    def _bounded(self, estimate: GapEstimate) -> Trend:
        """Moments of the state given that the gap exceeds an uncertain bound (the exact ones of a cut normal)."""
        column = self.covariance[:, GAP]
        spread = math.hypot(math.sqrt(column[GAP]), _bound_std(estimate))
        margin = (self.mean[GAP] - estimate.gap) / spread if spread > 0.0 else math.inf
        pull, cut = truncation(margin)
        gain = column / spread if spread > 0.0 else np.zeros(3)
        covariance = _symmetric(self.covariance - np.outer(gain, gain) * cut)
        reason = f"only a lower bound of {math.degrees(estimate.gap):.4g} deg: it counts where the trend lies below it"
        return replace(self, mean=self.mean + gain * pull, covariance=covariance, reasons=(reason,))

    @property
    def afresh(self) -> bool:
        """True right after the window with which the gap has started afresh."""
        return any(reason.startswith(_AFRESH) for reason in self.reasons)

    @property
    def moved(self) -> bool:
        """True right after the window with which the encoder's offset has been read anew, the gap being as expected."""
        return _MOVED in self.reasons

    @property
    def gap(self) -> float:
        """Total gap, rad, at least 0."""
        return max(0.0, float(self.mean[GAP]))

    @property
    def gap_std(self) -> float:
        """Standard deviation of the gap, the error shared by all windows included, rad."""
        return math.hypot(math.sqrt(self.covariance[GAP, GAP]), self.settings.shared_error(self.gap))

    @property
    def gap_interval(self) -> Interval:
        """95 % interval of the total gap, rad, cut at 0."""
        middle, half = float(self.mean[GAP]), NORMAL_95 * self.gap_std
        return max(0.0, middle - half), max(0.0, middle + half)

    @property
    def rate(self) -> float:
        """Growth of the total gap, rad/s."""
        return float(self.mean[RATE])

    @property
    def rate_std(self) -> float:
        """Standard deviation of the wear rate, rad/s."""
        return math.sqrt(self.covariance[RATE, RATE])

    @property
    def rate_interval(self) -> Interval:
        """95 % interval of the wear rate, rad/s; with both signs in it, wear is not yet established."""
        return self.rate - NORMAL_95 * self.rate_std, self.rate + NORMAL_95 * self.rate_std

    @property
    def prior(self) -> Prior:
        """Prior for the next window; predict to its time first."""
        return Prior(self.gap, self.gap_std, float(self.mean[OFFSET]), math.sqrt(self.covariance[OFFSET, OFFSET]))

    def as_estimate(self) -> GapEstimate:
        """The state as a prior for `estimate_gap`; predict to the next window's time first."""
        std = math.sqrt(self.covariance[GAP, GAP])
        return GapEstimate(self.gap, std, self.gap_std, self.gap_interval, GapStatus.OK, self.time, method="trend")

    def time_until(self, gap: float) -> Passage:
        """Time from now until the gap (rad, total) has grown to `gap`: see `servotwin.estimation.passage`.

        Raises
        ------
        InvalidInput
            The gap is negative or not finite.
        """
        if not 0.0 <= gap < math.inf:
            raise InvalidInput(f"trend: gap = {gap!r} rad: must be finite and at least 0")
        covariance = self.covariance[:OFFSET, :OFFSET].copy()
        covariance[GAP, GAP] += self.settings.shared_error(self.gap) ** 2
        return passage(
            self.mean[:OFFSET],
            covariance,
            gap,
            gap_walk=self.settings.gap_walk_rad_per_sqrt_s,
            rate_walk=self.settings.rate_walk_rad_per_s_per_sqrt_s,
        )


def _leans_on_offset(measurement: TrendMeasurement) -> bool:
    """Tell whether a gap was measured by means of the carried offset."""
    return bool(measurement.select[0, OFFSET] != 0.0)


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.T)


def _time(value: float) -> float:
    if not math.isfinite(value):
        raise InvalidInput(f"trend: time = {value!r} s: must be finite")
    return float(value)
