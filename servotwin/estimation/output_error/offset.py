"""The offset between the encoders of a free shaft, as a window with both flanks shows it."""

from __future__ import annotations

import math
from dataclasses import replace

from servotwin.estimation.estimate import GapEstimate, OffsetReading
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.output_error.models import HALF, OFFSET, ShaftModel


def with_offset(stated: GapEstimate, found: Search, unit: float) -> GapEstimate:
    """The estimate with its offset, rad at the motor; `unit`: total gap at the motor per half gap at the load.

    The offset is the middle between the flanks, and the gap their distance: whatever widens the one beyond its noise
    widens the other in proportion.
    """
    if not stated.ok or not isinstance(found.problem.model, ShaftModel):
        return stated
    at_load = 0.5 * unit
    gap, std = (found.best.std(which, found.free) for which in (HALF, OFFSET))
    if not (0.0 < gap < math.inf and std < math.inf):
        return stated
    wider = stated.std_total / (unit * gap)
    return replace(stated, offset=OffsetReading(at_load * float(found.best.values[OFFSET]), wider * at_load * std))
