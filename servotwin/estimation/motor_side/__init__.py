"""Estimator of the gap from the motor's encoder and the command alone, of axes with an elastic transmission."""

from servotwin.estimation.motor_side.estimator import (
    METHOD,
    MotorSideSettings,
    check_reaction,
    estimate,
    fit,
    shortest_window,
)

__all__ = ["METHOD", "MotorSideSettings", "check_reaction", "estimate", "fit", "shortest_window"]
