"""What the filter across windows calculates with: how its state moves, and what a window says of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import NORMAL_95, CarriedOffset, GapEstimate, OffsetReading
from servotwin.estimation.trend_settings import TrendSettings
from servotwin.plant.signals import Array

GAP, RATE, OFFSET = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Reading:
    """values (m,) = select (m, 3) state + noise of covariance (m, m)."""

    values: Array
    select: Array
    noise: Array

    @property
    def of_gap(self) -> Reading:
        """Its first value alone."""
        return Reading(self.values[:1], self.select[:1], self.noise[:1, :1])


def reading(estimate: GapEstimate, offset: OffsetReading | CarriedOffset | None) -> Reading:
    """What an OK estimate says of gap and offset.

    A gap that rests on the carried offset is none of its own: the window shows gap - slope offset. Taken as a gap, the
    offset's error would count anew with every such window, as if it were another each time.

    Raises
    ------
    InvalidInput
        The spreads make no covariance matrix.
    """
    variance = estimate.std_total**2
    if not 0.0 <= variance < math.inf:
        raise InvalidInput(f"trend: the estimate's std_total = {estimate.std_total!r} rad: must be finite")
    if offset is None:
        return Reading(np.array([estimate.gap]), np.eye(3)[:1], np.array([[variance]]))
    if isinstance(offset, CarriedOffset):
        own = max(0.0, variance - (offset.slope * offset.std) ** 2)
        select = np.array([[1.0, 0.0, -offset.slope]])
        return Reading(np.array([estimate.gap - offset.slope * offset.offset]), select, np.array([[own]]))
    noise = np.array([[variance, offset.covariance], [offset.covariance, offset.std**2]])
    if not np.all(np.isfinite(noise)) or np.any(np.linalg.eigvalsh(noise) < 0.0):
        raise InvalidInput(f"trend: {offset} and std_total = {estimate.std_total!r} rad make no covariance matrix")
    return Reading(np.array([estimate.gap, offset.offset]), np.eye(3)[[GAP, OFFSET]], noise)


def transition(step: float) -> Array:
    """(3, 3) matrix that carries the state on by `step` seconds."""
    flow = np.eye(3)
    flow[GAP, RATE] = step
    return flow


def process_noise(step: float, settings: TrendSettings) -> Array:
    """(3, 3) covariance that `step` seconds of the random walks add: exact, so that steps can be split at will."""
    gap, rate = settings.gap_walk_rad_per_sqrt_s**2, settings.rate_walk_rad_per_s_per_sqrt_s**2
    noise = np.zeros((3, 3))
    noise[GAP, GAP] = gap * step + rate * step**3 / 3.0
    noise[GAP, RATE] = noise[RATE, GAP] = rate * step**2 / 2.0
    noise[RATE, RATE] = rate * step
    noise[OFFSET, OFFSET] = settings.offset_walk_rad_per_sqrt_s**2 * step
    return noise


def bound_std(estimate: GapEstimate) -> float:
    """Spread (rad) of a lower bound, from the lower end of its 95 % interval."""
    return max(0.0, estimate.gap - estimate.interval[0]) / NORMAL_95


def truncation(margin: float) -> tuple[float, float]:
    """(shift, shrinkage) of a standard normal that is known to exceed -margin: its mean, one less its variance."""
    if math.isinf(margin):
        return 0.0, 0.0
    pull = math.exp(-0.5 * margin * margin - 0.5 * math.log(2.0 * math.pi) - float(log_ndtr(margin)))
    return pull, min(1.0, max(0.0, pull * (pull + margin)))
