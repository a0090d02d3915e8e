"""Verdicts on fits that show no gap."""

import numpy as np
import pytest

from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.kinematic.bootstrap import Spread
from servotwin.estimation.kinematic.verdict import KinematicFit, verdict


@pytest.mark.parametrize("reach", [0.5, 0.001])
def test_where_no_gap_is_seen_the_largest_lead_bounds_it(reach):
    # A load that hunts through a small gap fits best without one.
    fit = KinematicFit(
        gap=0.0,
        by_travel=0.0,
        simpler={},
        spread=Spread(np.zeros(300), np.zeros(300), np.zeros(300), 10),
        half=0.01,
        quantisation=0.002,
        left=0.001,
        better_than_none=False,
        reach=reach,
        lead=0.0,
    )
    judged = verdict(fit, "rad")
    assert judged.status is GapStatus.UNIDENTIFIABLE
    assert judged.interval == (0.0, max(reach, 0.01))
