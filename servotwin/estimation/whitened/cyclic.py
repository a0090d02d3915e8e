"""Sensors and screws that err once per turn of the motor.

An encoder that sits off its axis, and a screw whose pitch wobbles, err by a sine of the motor's angle. Within a part of
a turn this looks like another pitch, and in the motor's angle like another gap: the two contacts lie at different
angles. A whole turn would show it.
"""

from __future__ import annotations

import numpy as np

from servotwin.estimation.core.contacts import through_gap
from servotwin.estimation.whitened.reduction import Point, Reduction
from servotwin.plant.signals import Array


def cyclic_motions(reduction: Reduction, point: Point) -> Array:
    """(4, m) changes of the fitted position (m) per rad of a cyclic error: two of the position's, two of the angle's.

    Parameters
    ----------
    reduction : Reduction
    point : Point
        The fit's gap and place.
    """
    angle = reduction.theta_m
    waves = np.vstack([np.sin(angle), np.cos(angle)])
    own = reduction.response.static_gain * reduction.decimation.rows(waves)
    moved = through_gap(waves, angle, point.screw(0.0, reduction.rate))
    return np.vstack([own, reduction.reduced.respond(moved)])
