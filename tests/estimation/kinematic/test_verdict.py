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
        rms=0.001,
        of_none=1.2,
        reach=reach,
        accelerated=False,
        lead=0.0,
    )
    judged = verdict(fit, "rad")
    assert judged.status is GapStatus.UNIDENTIFIABLE
    assert judged.interval == (0.0, max(reach, 0.01))


def test_a_load_that_seems_noisier_than_its_gap_is_doubted_up_to_the_largest_lead():
    # A ball screw that hunted: 0.65 to 1.39 rad, "lost motion", for a gap of a turn.
    spread = Spread(*(np.full(300, 1.0) for _ in range(3)), 10)
    numbers = {"by_travel": 1.0, "simpler": {}, "spread": spread, "half": 0.2, "quantisation": 1e-3, "left": 0.05}
    fit = KinematicFit(gap=1.0, rms=2.0, of_none=0.1, reach=7.0, accelerated=False, lead=0.0, **numbers)
    judged = verdict(fit, "rad")
    assert judged.status is GapStatus.MODEL_MISMATCH
    assert judged.interval[1] == 7.0
    assert "it hunts, or the log is noisier than an encoder" in judged.reasons[0]
    assert verdict(fit._replace(rms=0.5), "rad").status is GapStatus.OK


def test_a_load_whose_acceleration_explains_as_much_as_a_gap_is_doubted():
    spread = Spread(*(np.full(300, 1.0) for _ in range(3)), 10)
    numbers = {"by_travel": 1.0, "simpler": {}, "spread": spread, "half": 0.1, "quantisation": 1e-3, "rms": 0.1}
    fit = KinematicFit(gap=1.0, left=0.05, of_none=0.7, reach=1.4, accelerated=True, lead=0.0, **numbers)
    judged = verdict(fit, "rad")
    assert judged.status is GapStatus.MODEL_MISMATCH
    assert judged.interval == (0.0, 1.4)
    assert "nearly as well without a gap: 70 %" in judged.reasons[0]
    assert verdict(fit._replace(accelerated=False), "rad").status is GapStatus.OK
    assert verdict(fit._replace(of_none=0.01), "rad").status is GapStatus.OK


def test_weightings_that_differ_by_less_than_a_hundredth_widen_the_interval_and_doubt_nothing():
    spread = Spread(*(np.full(300, 1.0) for _ in range(3)), 10)
    numbers = {"simpler": {}, "spread": spread, "half": 0.01, "quantisation": 1e-4, "left": 0.02, "rms": 0.02}
    fit = KinematicFit(gap=1.0, by_travel=1.005, of_none=0.1, reach=1.4, accelerated=False, lead=0.0, **numbers)
    judged = verdict(fit, "rad")
    assert judged.status is GapStatus.OK
    assert judged.interval == pytest.approx((0.95, 1.055))
    far = verdict(fit._replace(by_travel=1.02), "rad")
    assert far.status is GapStatus.MODEL_MISMATCH
    assert far.interval[1] == 1.4


def test_a_richer_model_that_may_be_right_widens_the_interval():
    # A gap of two counts, and a lag that nearly shows: 2.3 to 4.3 counts, ok, for 2.
    spread = Spread(*(np.full(300, 1.0) for _ in range(3)), 10)
    numbers = {"simpler": {}, "spread": spread, "half": 0.3, "quantisation": 0.1, "left": 0.02, "rms": 0.02}
    fit = KinematicFit(
        gap=1.0, by_travel=1.0, of_none=0.1, reach=1.4, accelerated=False, lead=0.0, richer=(0.75,), **numbers
    )
    judged = verdict(fit, "rad")
    assert judged.status is GapStatus.OK
    assert judged.interval == pytest.approx((0.45, 1.3))
    assert verdict(fit._replace(richer=(0.2,)), "rad").status is GapStatus.UNIDENTIFIABLE
