"""A gap of which friction's wind-up has been taken off."""

from dataclasses import replace

import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.wind_up import wind_up, with_machine
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
    known = with_machine(made, lost, SCREW)
    assert known.gap_motor == pytest.approx(lost.gap_motor - wind_up(SCREW))
    low, high = known.interval_motor
    assert low < 0.05 - 1.9 * wind_up(SCREW)
    assert high > 0.05
    assert "wind-up by the load's friction" in known.reasons[-1]
    assert known.status is GapStatus.OK


def test_a_gap_that_may_be_wind_up_is_not_known(found):
    made, lost = found
    small = replace(lost, gap_motor=1.5 * wind_up(SCREW), interval_motor=(1e-3, 1.3e-3))
    assert with_machine(made, small, SCREW).status is GapStatus.UNIDENTIFIABLE


@pytest.mark.parametrize(
    ("unit", "message"), [("um", "check the units of both columns"), ("counts", "load in 'counts'")]
)
def test_other_units_than_the_machine_s_are_refused(found, unit, message):
    made, lost = found
    with pytest.raises(InvalidInput, match=message):
        with_machine(replace(made, load_unit=unit), lost, SCREW)
