"""The chosen model of a recording, fitted closely around its gap, and half of the 95 % interval."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from servotwin.estimation.kinematic import bootstrap as draws
from servotwin.estimation.kinematic.models import Model, ModelScore
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.regression import Regression, Solution, columns, least_gap, products, solved
from servotwin.estimation.kinematic.search import FINE
from servotwin.estimation.kinematic.sensitivity import sensitivity
from servotwin.estimation.kinematic.strokes import counts_of, play_and_side
from servotwin.estimation.kinematic.verdict import structured
from servotwin.plant.signals import Array

_ROUNDS = 8
_END, _SAME = 0.9, 0.7  # of a grid's width: a minimum beyond lies outside; of the spread on a wider grid
_SHIFT = 0.5  # of what the model leaves, and of the difference of two weightings: standard deviation of the gap
_CHANCE = 0.025  # on either side of a 95 % interval


@dataclass(frozen=True, eq=False)
class CloseFit:
    """A model that was fitted closely.

    Attributes
    ----------
    gap : float
        In the motor's unit.
    by_travel : float
        The gap where each sample counts by the way of the motor, not by the time.
    spread : Spread
        Of the bootstrap.
    values, side : array
        Columns of the regression with that gap, and the flank that touches.
    places : list of int
        Of the model's columns.
    fit : Solution
    residual : array
        Of the load's position.
    ratio : float
        Load per motor.
    """

    gap: float
    by_travel: float
    spread: draws.Spread
    values: Array
    side: Array
    places: list[int]
    fit: Solution
    residual: Array
    ratio: float


class HalfWidth(NamedTuple):
    """Half of the 95 % interval.

    Attributes
    ----------
    at_motor, at_load : float
        Each in its unit.
    quantile : float
        Standard deviations within it.
    quantisation, left : float
        Of its causes: standard deviation of both counts, and the residual that repeats itself; in the motor's unit.
    """

    at_motor: float
    at_load: float
    quantile: float
    quantisation: float
    left: float


def fitted_closely(prepared: Regression, best: ModelScore, least: float) -> CloseFit:
    """Fit a model around the gap of its score, on a grid at least `least` to either side."""
    gap, by_travel, spread = _fitted(prepared, best.model, best.gap, max(0.5 * best.gap, least))
    values, side = columns(prepared, gap)
    places = best.model.places(prepared)
    fit = solved(values @ values.T, places)
    residual, ratio = values[0] - fit.coefficients @ values[places], float(fit.coefficients[0])
    return CloseFit(gap, by_travel, spread, values, side, places, fit, residual, ratio)


def half_width(recording: EncoderRecording, prepared: Regression, close: CloseFit) -> HalfWidth:
    """Half of the 95 % interval: bootstrap, counts, what the model leaves, and the difference of two weightings."""
    ratio, spread = close.ratio, close.spread
    motor_count, load_count = counts_of(recording)
    quantisation = math.hypot(motor_count, load_count / abs(ratio)) / math.sqrt(12.0)
    quantile = float(stdtrit(max(spread.units - 1, 1), 1.0 - _CHANCE))
    left = structured(prepared, close.residual) / abs(ratio)
    # Counts and what the model leaves are the same in every cycle: the bootstrap does not see that they shift the gap.
    shift = _SHIFT * (close.by_travel - close.gap)
    of_model = sensitivity(close.values, close.places, close.side, close.gap)
    at_motor = quantile * math.hypot(spread.std, quantisation, of_model.motor * _SHIFT * left, shift)
    at_load = math.hypot(
        spread.std_at_load, *(abs(ratio) * each for each in (quantisation, of_model.load * _SHIFT * left, shift))
    )
    return HalfWidth(at_motor, quantile * at_load, quantile, quantisation, left)


def _fitted(prepared: Regression, model: Model, gap: float, width: float) -> tuple[float, float, draws.Spread]:
    """Gap by time and by travel, and their bootstrap, on grids that are narrowed to the spread."""
    places = model.places(prepared)
    travel, least = _travel(prepared), 1e-3 * max(gap, width)
    before = math.inf
    for _ in range(_ROUNDS):
        middle = gap
        grid = np.linspace(max(middle - width, 0.0), middle + width, FINE)
        by_time, by_travel = (
            np.array(each) for each in zip(*(products(prepared, each, travel) for each in grid), strict=True)
        )
        spread = draws.bootstrap(grid, by_time, by_travel, places)
        gap, other = (float(least_gap(grid, solved(each.sum(axis=1), places).squares)) for each in (by_time, by_travel))
        wanted = max(5.0 * spread.std, 1.5 * abs(other - gap), least)
        at_end = abs(gap - middle) > _END * width and gap > grid[0]
        if not at_end and 0.4 * width <= wanted <= 1.5 * width and spread.std > _SAME * before:
            break
        # The parabola through three points of a wide grid is off by more than the draws spread, and so is theirs: the
        # grid narrows by steps, and a spread counts where a finer grid has it too.
        before = spread.std
        width = 2.0 * width if at_end else wanted if wanted > width else max(min(wanted, 0.5 * width), 0.25 * width)
    return gap, other, spread


def _travel(prepared: Regression) -> Array:
    """Way of the motor from one row to the next, its counts and noise left out, relative to the mean."""
    motor = prepared.recording.motor
    side = np.zeros(motor.size, dtype=np.int8)
    smooth = play_and_side(motor, 2.0 * counts_of(prepared.recording)[0], side)[prepared.rows]
    way = np.abs(np.diff(smooth, prepend=smooth[0]))
    alone = prepared.recording.alone
    if alone is not None:
        # The first sample of a stretch is not the one that has moved by all that a thinned log leaves out.
        behind = np.diff(np.cumsum(alone)[prepared.rows], prepend=0) > 0
        way[behind] = np.roll(way, -1)[behind]
    return way / max(float(way.mean()), np.finfo(float).tiny)
