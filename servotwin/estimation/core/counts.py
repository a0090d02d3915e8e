"""An angle between the counts of its encoder."""

from __future__ import annotations

import numpy as np

from servotwin.plant.signals import Array


def between_counts(angle: Array, count: float) -> Array:
    """(n,) angle that comes in counts (rad), by straight lines between the instants at which it changes.

    There the angle is half-way between two counts. A count that is left to where it was reached, as at a turning point,
    holds for its middle. The error is at most half a count, and small where the angle moves: a staircase shakes a
    structure that it drives, and a fit that sees nothing of that takes it for damped.
    """
    changes = np.flatnonzero(np.diff(np.round(angle / count)))
    if changes.size == 0:
        return angle
    begins, ends = np.append(0, changes + 1), np.append(changes, angle.size - 1)
    ways = np.sign(angle[changes + 1] - angle[changes])
    turned = np.concatenate([[True], ways[1:] != ways[:-1], [True]])
    times = np.concatenate([changes + 0.5, 0.5 * (begins + ends)[turned]])
    values = np.concatenate([0.5 * (angle[changes] + angle[changes + 1]), angle[begins[turned]]])
    order = np.argsort(times)
    return np.interp(np.arange(angle.size), times[order], values[order])
