"""Quick fit of a window without the load's position, beside another window of the same machine.

It tells whether the gap has moved, as that of `servotwin.estimation.output_error.quick` does.
"""

from __future__ import annotations

import numpy as np

from servotwin.estimation.motor_side.estimator import problem_of
from servotwin.estimation.motor_side.settings import MotorSideSettings
from servotwin.estimation.motor_side.verdict import DOUBT
from servotwin.estimation.output_error.quick import SpreadParts, fit_beside, unknowns_in
from servotwin.estimation.whitened.quick import QuickFit
from servotwin.estimation.window import Window
from servotwin.plant.axis import Axis
from servotwin.plant.signals import Array

_OWN = MotorSideSettings()
_SPREAD = SpreadParts(DOUBT, _OWN.model_share, 0.25)  # as the estimator's own


def quick_fit(window: Window, axis: Axis, unknowns: Array) -> QuickFit:
    """Fit the gap of a window beside the unknowns (u,) of another one; raises InvalidInput as the estimator does."""
    return fit_beside(problem_of(window, axis, _OWN), np.asarray(unknowns), 2.0 / axis.p, _SPREAD)


def unknowns_at(window: Window, axis: Axis, gap: float) -> Array:
    """Unknowns (u,) of a window whose total gap (rad) was estimated; raises InvalidInput as the estimator does."""
    return unknowns_in(problem_of(window, axis, _OWN), 0.5 * axis.p * gap)
