"""Ratio of a rigid screw that a window teaches, with what a gap that grows within the window does to it."""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.estimate import MachineReading
from servotwin.estimation.output_error.fit import Search, only_rounding
from servotwin.estimation.output_error.models import RATIO
from servotwin.estimation.output_error.possible import INDEPENDENT, PossibleHalf
from servotwin.estimation.output_error.problem import Problem
from servotwin.estimation.whitened.doubt import spread_over
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.plant.signals import Array

_TELLS = 0.5  # of the standard deviation of a ratio that was known: a window that tells it better is learnt from
_GROWTH = 0.1  # of the gap, usual growth within a window where it does not stand still
_STEPS = (0.25, 0.5, 0.75)  # of the window, times at which a gap may grow at once
_DIFFERENCE = 1e-3  # of the gap, that makes a derivative


def taught(machine: FactorPrior, found: Search, possible: PossibleHalf, calibration: float) -> MachineReading | None:
    """Return the machine with the ratio that a window leaves possible; None where that was known nearly as well before.

    Moves between the same two places tell a ratio hardly, and their errors of rounding repeat: many such windows would
    only seem to tell more. A gap that grew while the moves became longer would seem to be ratio: its spread contains
    that, as far as the window makes a growth likely.
    """
    (mean, known), std = machine.pitch, math.hypot(possible.ratio_std, moved_by_growth(found))
    std *= calibration
    return machine.with_pitch(mean + possible.ratio, std).reading if std < _TELLS * known else None


def moved_by_growth(found: Search) -> float:
    """Root mean square of the changes of the ratio's logarithm by a gap that grows within the window.

    The gap may grow evenly, or at once at some times; each way counts by how likely the window makes it.
    """
    fit, shapes = found.best, _growths(found)
    free = [RATIO, *(int(place) for place in np.flatnonzero(found.free) if place != RATIO)]
    known, data, size = len(free), fit.raw.size, fit.residual.size
    rows = np.zeros((known + len(shapes), size + len(shapes)))
    rows[:known, :size], rows[known:, :data] = fit.rows[free], shapes
    rows[known:, size:] = np.eye(len(shapes))
    residual, variance = np.concatenate([fit.residual, np.zeros(len(shapes))]), fit.variance()
    if only_rounding(found.problem, fit):
        # However many samples there are, they hold a few independent errors.
        weight = math.sqrt(min(1.0, INDEPENDENT / data))
        rows[:, :data] *= weight
        residual[:data] *= weight
    return spread_over(residual, rows, known, [[place] for place in range(known, len(rows))], variance)


def _growths(found: Search) -> Array:
    """(g, m) whitened changes of the position by growths of the gap, each of a usual size."""
    problem, values = found.problem, found.best.values
    assert isinstance(problem, Problem)
    time = np.linspace(0.0, 1.0, problem.drive.size)
    shapes: list[Array] = [time - 0.5, *(np.where(time > step, 0.5, -0.5) for step in _STEPS)]
    grown = np.array([problem.misfit_in_growing_gap(values, 1.0 + _DIFFERENCE * shape) for shape in shapes])
    return found.noise.whiten((grown - found.best.raw) * (_GROWTH / _DIFFERENCE))
