"""One fit from one start, in white noise: what the whitened estimator is made of, for whoever has many windows."""

from __future__ import annotations

import numpy as np

from servotwin.estimation.core.response import response
from servotwin.estimation.whitened.misfit import Point
from servotwin.estimation.whitened.reduction import Reduction
from servotwin.estimation.whitened.search import Fit, descend
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo

_PRECISION = 1e-9  # of the motor's range


def plain_fit(window: Window, servo: Servo, gap: float) -> Fit:
    """The minimum nearest to a total gap (rad): no whitening, no other start, no verdict, no delay.

    The screw begins in the middle of the gap.
    """
    assert window.theta_m is not None
    reduction = Reduction.of(window.theta_m, window.position, response(servo, window.sample_rate), skew=False)
    span = float(np.ptp(window.theta_m))
    return descend(reduction.coarse(), Point(gap, 0.0), 2.0 * span, _PRECISION * span)
