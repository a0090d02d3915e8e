"""Search for the gap: coarsely first, then with each model, with the lag where it belongs."""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.kinematic.cyclic import periods
from servotwin.estimation.kinematic.models import Model, ModelScore, compared
from servotwin.estimation.kinematic.regression import (
    INERTIA,
    LAG,
    RATIO,
    Regression,
    Solution,
    columns,
    products,
    solved,
)
from servotwin.plant.signals import Array

# Of the coarse search: geometric from a count to the whole travel, then next to the best, so many grids in all.
_GAPS, _BETWEEN, _FINER = 24, 9, 3
_NEAR = 0.12  # of the coarse gap, the span of finer steps on either side
FINE = 17
"""Gaps of each finer grid."""


def coarse_gap(prepared: Regression, least: float) -> float:
    """Gap of the least sum of squares on a geometric grid and finer ones, everything else free but the lag.

    Until the first contact the load rests, wherever in the gap: on the wide grid its motion until then counts against
    the gap, next to the best gap it does not count.
    """
    reach = float(np.ptp(prepared.recording.motor))
    used = Model("", (RATIO, "offset")).places(prepared)

    def error(gap: float, rests_count: bool) -> float:
        values, side = columns(prepared, gap)
        known, resting = values[:, side != 0], values[0, side == 0]
        squares = float(solved(known @ known.T, used).squares)
        if rests_count:
            return squares + resting.size * _variance(resting)
        return squares / known.shape[1] if known.shape[1] > resting.size else math.inf

    grid, rest = np.concatenate([[0.0], np.geomspace(0.1 * least, 0.95 * reach, _GAPS)]), True
    for _ in range(_FINER):
        best = int(np.argmin([error(gap, rest) for gap in grid]))
        found = float(grid[best])
        grid, rest = np.linspace(grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)], _BETWEEN), False
    return found


def _variance(values: Array) -> float:
    return float(np.var(values)) if values.size else 0.0


def cyclic_periods(prepared: Regression, gap: float) -> tuple[float, ...]:
    values, _ = columns(prepared, gap)
    used = Model("", (RATIO, "offset", LAG)).places(prepared)
    fit = solved(values @ values.T, used)
    return periods(values[1], values[0] - fit.coefficients @ values[used])


def compared_models(prepared: Regression, coarse: float, least: float) -> tuple[ModelScore, ...]:
    grid, tensor = _tensor(prepared, coarse, least)
    return compared(prepared, grid, tensor, np.diff(prepared.bounds, append=prepared.rows.size))


def compared_with_fitted_lag(
    prepared: Regression, comparisons: tuple[ModelScore, ...], coarse: float, least: float
) -> tuple[ModelScore, ...]:
    """The models with a lag, compared again with the lag in the time.

    Its column is right to first order only: what is left of a long lag looks like wind-up by acceleration.
    """
    simple = next(each for each in comparisons if LAG in each.model.used and INERTIA not in each.model.used)
    again = compared_models(with_lag(prepared, simple), coarse, least)
    return tuple(new if LAG in new.model.used else old for old, new in zip(comparisons, again, strict=True))


def _tensor(prepared: Regression, coarse: float, least: float) -> tuple[Array, Array]:
    """Sums of products on a grid from 0 to twice the coarse gap, finer next to it."""
    most = max(coarse, least)
    near = np.linspace(1.0 - _NEAR, 1.0 + _NEAR, FINE)
    grid = most * np.unique(np.concatenate([np.linspace(0.0, 2.0, FINE), near]))
    return grid, np.array([products(prepared, gap)[0] for gap in grid])


def with_lag(prepared: Regression, best: ModelScore) -> Regression:
    """The design with the lag moved from its column, which is right to first order, into the time."""
    places = best.model.places(prepared)
    for _ in range(3):
        values, _ = columns(prepared, best.gap)
        prepared = prepared._replace(lag=prepared.lag + lag_left(prepared, solved(values @ values.T, places), places))
    return prepared


def lag_left(prepared: Regression, fit: Solution, places: list[int]) -> float:
    """Lag that a fit finds beyond the one of the regression, s; 0 where the model has none."""
    column = prepared.names.index(LAG)
    return float(fit.coefficients[places.index(column)] / fit.coefficients[0]) if column in places else 0.0
