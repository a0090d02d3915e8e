"""Errors of sensors and screws as changes of the fitted position: one that lags, one that errs once per turn.

A sensor that lags in place of one that is late delays its channel, and rounds it off besides. A fit takes off the delay
between the channels, whatever its cause. A first-order lag of that time constant leaves half of its square times the
acceleration. In the motor's angle this clips the crests, at which contacts end, so that the gap seems to have another
size.

An encoder that sits off its axis, and a screw whose pitch wobbles, err by a sine of the motor's angle. Within a part of
a turn this looks like another pitch, and in the motor's angle like another gap: the two contacts lie at different
angles. A whole turn would show it.
"""

from __future__ import annotations

import numpy as np

from servotwin.estimation.core.contacts import SCREW, through_gap
from servotwin.estimation.paper.observer import LagFilter
from servotwin.estimation.whitened.reduction import Point, Reduction
from servotwin.plant.signals import Array


def lag_motion(reduction: Reduction, point: Point, screw: Array, delay: float) -> Array:
    """(m,) change of the fitted position if the channel that is late lags.

    Parameters
    ----------
    reduction : Reduction
    point : Point
        The fit's gap and place.
    screw : (4, n) array
        The screw's angle there, with its derivatives.
    delay : float
        s, by which the position is late; below 0 it is the angle that is late.
    """
    interval = reduction.response.interval
    if delay >= 0.0:
        speed = reduction.reduced.velocities(screw[SCREW : SCREW + 1])[0]
        return np.asarray(0.5 * delay**2 * np.gradient(speed, interval * reduction.decimation.factor))
    angle, late = reduction.theta_m, -delay
    time = interval * np.arange(angle.size)
    lagged = LagFilter.sampled(np.array([1.0 / late]), 1, 1.0 / late, interval).respond(angle)
    # To second order the true angle differs from the delayed one by as much as this one's lag from its delay.
    clipped = np.interp(time - late, time, angle) - lagged
    moved = through_gap(clipped[None], angle, point.screw(0.0, reduction.rate))
    return np.asarray(reduction.reduced.respond(moved)[0])


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
