"""Output-error estimator of the gap of axes whose shaft is free in the gap, and of one mass behind a rigid screw."""

from servotwin.estimation.output_error.estimator import METHOD, OutputErrorSettings, estimate, fit, shortest_window
from servotwin.estimation.output_error.sampling import least_rate, too_slow

__all__ = ["METHOD", "OutputErrorSettings", "estimate", "fit", "least_rate", "shortest_window", "too_slow"]
