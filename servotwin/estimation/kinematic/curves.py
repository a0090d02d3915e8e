"""Curves for a picture of a fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.estimation.kinematic.models import Model
from servotwin.estimation.kinematic.regression import Regression, Solution, columns, solved
from servotwin.plant.signals import Array


class FittedCurves(NamedTuple):
    """Curves for a picture of the fit.

    Attributes
    ----------
    time, load, lead, residual : (k,) array
        Times in s, positions of the load, by how much the motor leads it (the motor's unit), and what the model leaves
        (the load's).
    gaps, rms : (g,) array
        Error of the model, the load's unit, for other gaps.
    """

    time: Array
    load: Array
    lead: Array
    residual: Array
    gaps: Array
    rms: Array


def fitted_curves(prepared: Regression, model: Model, gap: float, grid: Array, squares: Array) -> FittedCurves:
    """Draw a model with a gap (the motor's unit); `squares` (g,) are what it leaves with the gaps of a grid."""
    recording, rows = prepared.recording, prepared.rows
    values, _ = columns(prepared, gap)
    places = model.places(prepared)
    fit = solved(values @ values.T, places)
    return FittedCurves(
        time=recording.time[rows],
        load=values[0],
        lead=recording.motor[rows] - _follower(values, fit, places),
        residual=values[0] - fit.coefficients @ values[places],
        gaps=grid,
        rms=np.sqrt(squares / rows.size),
    )


def _follower(values: Array, fit: Solution, places: list[int]) -> Array:
    """The load's position in the motor's unit, without what is neither ratio nor gap, such as an offset."""
    others = fit.coefficients[1:] @ values[places[1:]]
    return (values[0] - others) / fit.coefficients[0]
