"""Curves for a picture of a fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.estimation.estimate import Interval
from servotwin.estimation.kinematic.models import Model
from servotwin.estimation.kinematic.regression import Regression, Solution, columns, solved
from servotwin.plant.signals import Array

_PROFILE = 25  # gaps


class FittedCurves(NamedTuple):
    """Curves for a picture of the fit.

    Attributes
    ----------
    time, load, lead, residual : (k,) array
        Times in s, positions of the load, by how much the motor leads it (the motor's unit, the lag taken off), and
        what the model leaves (the load's).
    gaps, rms : (g,) array
        Error of the model, the load's unit, for gaps from 0 to beyond the one found; empty for a model of the dynamics.
    """

    time: Array
    load: Array
    lead: Array
    residual: Array
    gaps: Array
    rms: Array

    def with_load_times(self, scale: float) -> FittedCurves:
        """The same in a unit of the load that is `scale` times smaller."""
        return self._replace(load=scale * self.load, residual=scale * self.residual, rms=scale * self.rms)


def fitted_curves(prepared: Regression, model: Model, gap: float, interval: Interval) -> FittedCurves:
    """Draw a model with a gap and its 95 % interval (the motor's unit); `prepared` has the fitted lag."""
    recording, rows, places = prepared.recording, prepared.rows, model.places(prepared)
    values, _ = columns(prepared, gap)
    fit = solved(values @ values.T, places)
    motor = np.interp(recording.time[rows] - prepared.lag, recording.time, recording.motor) - recording.motor[0]
    reach = float(np.ptp(recording.motor))
    most = min(max(2.0 * gap, 1.2 * interval[1] if np.isfinite(interval[1]) else 0.0), 0.9 * reach) or 0.5 * reach
    gaps = np.unique(np.append(np.linspace(0.0, most, _PROFILE), gap))
    return FittedCurves(
        time=recording.time[rows],
        load=recording.load[rows],
        lead=motor - _follower(values, fit, places),
        residual=values[0] - fit.coefficients @ values[places],
        gaps=gaps,
        rms=np.sqrt([_squares(prepared, each, places) / rows.size for each in gaps]),
    )


def _squares(prepared: Regression, gap: float, places: list[int]) -> float:
    values, _ = columns(prepared, gap)
    return float(solved(values @ values.T, places).squares)


def _follower(values: Array, fit: Solution, places: list[int]) -> Array:
    """The load's position in the motor's unit, without what is neither ratio nor gap, such as an offset."""
    others = fit.coefficients[1:] @ values[places[1:]]
    return (values[0] - others) / fit.coefficients[0]
