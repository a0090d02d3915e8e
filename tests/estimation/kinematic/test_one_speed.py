"""A load that is late at one speed: what looks like a gap may be none."""

import pytest

from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from tests.support.recordings import to_and_fro


@pytest.mark.parametrize(
    "made",
    [
        {"lag": 0.05},
        {"lag": 0.01},
        {"delay": 0.01},
        {"lag": 0.01, "gap": 0.05},
        {"lag": 0.05, "count": 0.02},
        {"lag": 0.05, "count": 0.05},
        {"lag": 0.02, "speeds": (3.0, 2.9)},
    ],
)
def test_at_one_speed_a_lag_that_may_be_all_of_it_leaves_the_gap_open(made):
    found = estimate_lost_motion(to_and_fro(**made))
    assert found.status is GapStatus.UNIDENTIFIABLE
    assert found.interval_motor[0] == 0.0
    assert made.get("gap", 0.0) < found.interval_motor[1] < 0.5
    assert "steadily at one speed only" in found.reasons[0]


def test_a_gap_alone_is_left_open_too():
    found = estimate_lost_motion(to_and_fro(gap=0.05))
    assert found.status is GapStatus.UNIDENTIFIABLE
    assert found.at_motor == pytest.approx(0.05, abs=1e-3)
    assert "a load that is later by 8.3" in found.reasons[0]


@pytest.mark.parametrize("made", [{"speeds": (3.0, 1.2)}, {"rest": 0.5}], ids=["two speeds", "rests"])
@pytest.mark.parametrize("late", [{"lag": 0.01}, {"delay": 0.01}, {}], ids=["lag", "delay", "neither"])
def test_a_second_speed_or_rests_tell(made, late):
    found = estimate_lost_motion(to_and_fro(gap=0.05, **made, **late))
    assert found.ok
    assert found.interval_motor[0] < 0.05 < found.interval_motor[1] < 0.07
