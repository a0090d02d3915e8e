"""The encoder's offset as a window shows it, beside the gap that was found there.

Position / static gain less the screw's angle: what the encoder would have to be shifted by for both to agree at rest.
It is a constant in the residual, so it costs nothing to read once the gap is known; what earlier windows tell of it
lets later ones show the gap with one contact only.
"""

from __future__ import annotations

import math

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.identify.core.contacts import BY_GAP, BY_START, SCREW, Gap, contacts
from servotwin.identify.core.normal import least_squares
from servotwin.identify.core.response import response
from servotwin.identify.estimate import GapEstimate
from servotwin.identify.trend import OffsetReading
from servotwin.identify.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array


def read_offset(window: Window, servo: Servo, estimate: GapEstimate) -> OffsetReading:
    """The offset (rad) with its standard deviation and its covariance with the gap.

    Shape of the covariance: that of white noise; size: such that the gap's variance is the estimate's `std_total`
    squared, so that whatever that accounts for widens the offset in proportion.

    Raises
    ------
    InvalidInput
        The estimate is not OK, or the window has no theta_m.
    """
    if window.theta_m is None or not estimate.ok:
        missing = "theta_m" if window.theta_m is None else "an OK estimate"
        raise InvalidInput(f"{window.where}the encoder's offset needs {missing}")
    model = response(servo, window.sample_rate)
    first, home = float(window.theta_m[0]), float(window.position[0])
    seen = contacts(window.theta_m - first, Gap(estimate.gap, estimate.theta_d0 - first))
    rows = model.respond(seen[[SCREW, BY_GAP, BY_START]])
    constant = np.full((1, window.theta_m.size), model.static_gain)
    late = model.velocities(seen[[SCREW]])
    columns = np.vstack([rows[1:2], constant, rows[2:], model.free(window.theta_m.size), late])
    solved = least_squares(np.delete(columns, 0, axis=0), window.position - home - rows[0])
    covariance = _scaled(least_squares(columns, rows[0]).root, estimate.std_total)
    offset = float(solved.coefficients[0]) + home / model.static_gain - first
    return OffsetReading(offset, math.sqrt(covariance[1, 1]), float(covariance[0, 1]))


def _scaled(root: Array, std: float) -> Array:
    """(2, 2) covariance of gap and offset, scaled to a standard deviation of the gap (rad)."""
    pair = root[:, :2]
    covariance = pair.T @ pair
    return np.asarray(covariance * (std * std / float(covariance[0, 0])))
