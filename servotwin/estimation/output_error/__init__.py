"""Output-error estimator of the gap of axes that no servo stands for: a shaft that is free in the gap, a load with
friction behind a screw that the gap holds, one mass."""

from servotwin.estimation.output_error.estimator import METHOD, OutputErrorSettings, estimate, fit, shortest_window
from servotwin.estimation.output_error.held_chain import follows
from servotwin.estimation.output_error.sampling import least_rate, too_slow

__all__ = ["METHOD", "OutputErrorSettings", "estimate", "fit", "follows", "least_rate", "shortest_window", "too_slow"]
