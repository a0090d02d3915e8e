"""An estimator that knows the truth: it shows what the loop could do if estimation were perfect."""

from __future__ import annotations

from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.window import Window
from servotwin.plant.signals import SignalLike, as_nonnegative
from servotwin.twin.estimating import Estimator
from servotwin.twin.wear import Expectation


def known_gap(gap: SignalLike, duration: float) -> Estimator:
    """An estimator that ignores the measurements and gives the true total gap in the middle of the window.

    Parameters
    ----------
    gap : number or signal
        rad, total gap.
    duration : float
        s, up to when the signal is asked for.
    """
    truth = as_nonnegative(gap, duration, "gap", "rad")

    def estimate(window: Window, _expected: Expectation) -> GapEstimate:
        middle = window.start + 0.5 * window.duration
        value = max(0.0, float(truth.value(middle)))
        return GapEstimate(value, 0.0, 0.0, (value, value), GapStatus.OK, middle, method="known")

    return estimate
