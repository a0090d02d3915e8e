"""Growth of a gap over several recordings, in calendar time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from servotwin.estimation.estimate import NORMAL_95

YEAR = 365.25 * 86400.0
"""s."""
LEAST = 3  # recordings


class GapGrowth(NamedTuple):
    """Line through the gaps of recordings.

    Attributes
    ----------
    per_year : float
        The gap's unit per year.
    std : float
        Its standard deviation; larger than the gaps' own make it where they scatter about the line by more than that.
    deviations : float
        Standard deviations on either side of a 95 % interval: by Student's distribution where the scatter makes `std`.
    """

    per_year: float
    std: float
    deviations: float

    @property
    def interval(self) -> tuple[float, float]:
        """95 %."""
        return self.per_year - self.deviations * self.std, self.per_year + self.deviations * self.std


def growth(dates: ArrayLike, gaps: ArrayLike, stds: ArrayLike) -> GapGrowth | None:
    """Fit a line by weighted least squares; None where fewer than three gaps are known, or all on one date.

    Parameters
    ----------
    dates : (n,) array_like
        s.
    gaps, stds : (n,) array_like
        In one unit; gaps that are not finite, or whose deviations are not, do not count.
    """
    table = np.array([dates, gaps, stds], dtype=float)
    years, values, spread = table[:, np.isfinite(table).all(axis=0) & (table[2] > 0.0)]
    if values.size < LEAST or not np.ptp(years) > 0.0:
        return None
    weights, years = spread**-2, (years - years.mean()) / YEAR
    middle = float(np.average(years, weights=weights))
    moment = float(np.sum(weights * (years - middle) ** 2))
    slope = float(np.sum(weights * (years - middle) * values)) / moment
    left = values - np.average(values, weights=weights) - slope * (years - middle)
    scatter = float(np.sum(weights * left**2)) / (values.size - 2)
    deviations = float(stdtrit(values.size - 2, 0.975)) if scatter > 1.0 else NORMAL_95
    return GapGrowth(slope, math.sqrt(max(scatter, 1.0) / moment), deviations)
