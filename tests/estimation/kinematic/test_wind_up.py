"""A gap of which friction's wind-up has been taken off."""

import math
from dataclasses import replace

import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.wind_up import gap_of_machine, gap_within, wind_up
from servotwin.plant.axis import Axis

SCREW = Axis.preset("ball-screw")  # 15 N, 5e7 N/m, 5 mm per turn


@pytest.fixture(scope="module")
def found():
    made = recording(gap=0.05, ratio=1e3 * SCREW.p, seconds=12.0, rate=200.0, noise=1e-5)
    made = replace(made, load_unit="mm")
    return made, estimate_lost_motion(made)


def test_the_wind_up_is_twice_friction_over_stiffness():
    assert wind_up(SCREW) == pytest.approx(2.0 * 15.0 / 5e7 / SCREW.p)
    assert wind_up(Axis.preset("emps")) == 0.0


def test_it_is_taken_off_and_widens_the_interval(found):
    made, lost = found
    known = gap_of_machine(made, lost, SCREW)
    assert known.gap_motor == pytest.approx(lost.at_motor - wind_up(SCREW))
    low, high = known.interval_motor
    assert low < 0.05 - 1.9 * wind_up(SCREW)
    assert high > 0.05
    assert "wind-up by the load's friction" in known.reasons[-1]
    assert known.status is GapStatus.OK


def test_without_a_machine_the_gap_is_at_most_the_lost_motion(found):
    _, lost = found
    unknown = gap_within(lost, None)
    assert lost.ok
    assert unknown.status is GapStatus.LOST_MOTION
    assert unknown.interval_motor == (0.0, lost.interval_motor[1])
    assert math.isnan(unknown.gap_load)
    stiff = gap_within(lost, 0.0)
    assert stiff.ok
    assert stiff.interval_load == lost.interval_load


def test_a_load_that_does_not_follow_may_stick(found):
    bound = replace(found[1], status=GapStatus.LOWER_BOUND, at_motor=3.0, interval_motor=(3.0, math.inf))
    assert gap_within(bound, None).interval_motor == (0.0, math.inf)
    assert gap_within(bound, 0.2).interval_motor == (pytest.approx(2.6), math.inf)
    assert gap_within(bound, 0.0).interval_motor == (3.0, math.inf)


def test_a_gap_that_may_be_wind_up_is_not_known(found):
    made, lost = found
    small = replace(lost, at_motor=1.5 * wind_up(SCREW), interval_motor=(1e-3, 1.3e-3))
    assert gap_of_machine(made, small, SCREW).status is GapStatus.UNIDENTIFIABLE


@pytest.mark.parametrize(
    ("unit", "message"), [("um", "check the units of both columns"), ("counts", "load in 'counts'")]
)
def test_other_units_than_the_machine_s_are_refused(found, unit, message):
    made, lost = found
    with pytest.raises(InvalidInput, match=message):
        gap_of_machine(replace(made, load_unit=unit), lost, SCREW)
