"""Windows of a stepper before an elastic screw in which the load moves one way only.

A loop with integral action alone comes to rest exponentially, and of such a motion a lag takes away a constant share:
the load's damping, a ratio and with it the gap look alike. A motion back tells them apart.
"""

from __future__ import annotations

import numpy as np

from servotwin.estimation.core.visible import counted
from servotwin.plant.actuator import Stepper
from servotwin.plant.axis import Axis
from servotwin.plant.backlash import play
from servotwin.plant.basis import BacklashKind
from servotwin.plant.signals import Array

_BACK = 0.01  # of the way one way: least way back
_COUNTS = 3.0  # of the position, which rounding and noise move to and fro


def moves_one_way(axis: Axis, position: Array) -> str:
    """Sentence for a window of a stepper's position (n,) that a lag explains as a gap does; empty: none."""
    if not isinstance(axis.actuator, Stepper) or axis.backlash_kind is not BacklashKind.HELD:
        return ""
    count = max(counted(position), axis.sensors.position_resolution)
    steps = np.diff(play(position, _COUNTS * count, float(position[0])))
    ways = float(np.sum(steps[steps > 0.0])), -float(np.sum(steps[steps < 0.0]))
    if min(ways) >= _BACK * max(ways):
        return ""
    share = 100.0 * min(ways) / max(ways)
    return (
        f"the load moves one way, and back by {share:.2g} % of it, where a lag of the load looks like another ratio "
        "and another gap; a window with a motion to and fro would show the gap"
    )
