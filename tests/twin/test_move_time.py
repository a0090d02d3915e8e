"""Time of a move, and windows that last as long."""

import math

import pytest
from scaling import AxisUnits, Units, scaled, scaled_axis

import servotwin as st
from servotwin.commissioning.edge_settings import Commissioning, Recording
from servotwin.commissioning.move_time import move_time
from servotwin.plant.scales import scales
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.twin.settings import TwinSettings

STAGE = st.Axis(
    st.VelocityDrive(1e-6),
    st.Transmission(1e-3),
    st.Load(m=(1.0,), k=(0.0,), c=(1.0,)),
    st.Cascade(position_gain=20.0, ratio=1e-3),
)
"""A drive that follows its speed command, and a load that follows the drive: the position is a first-order lag."""

RACK = st.Axis(
    st.TorqueDrive(J=8e-4, lag=5e-4, friction=2e-3, coulomb=0.05),
    st.Transmission(p=0.04 / (2.0 * math.pi), k_d=2e7, c_d=4e3, in_gap="free"),
    st.Load(m=(150.0,), k=(0.0,), c=(300.0,), friction=60.0),
    st.Cascade(position_gain=22.4, ratio=0.04 / (2.0 * math.pi), velocity_gain=0.079, sample_rate=4000.0),
)
OWN = RACK.replace(velocity_gain=0.79)
"""The same with its own controller: the law above, a fallback set for one, is a tenth as strong."""


@pytest.mark.parametrize("rate", [None, 10e3])
def test_a_first_order_lag_takes_three_time_constants(rate: float | None) -> None:
    taken = move_time(STAGE, STAGE.controller.replace(sample_rate=rate), 0.0, 1e-3, 1.0)
    assert taken == pytest.approx(math.log(20.0) / 20.0, abs=2e-3)


def test_what_does_not_move_takes_no_time() -> None:
    """Friction holds the load under the whole command of the step."""
    assert move_time(RACK, RACK.controller, 0.0, 1e-6, 0.5) == 0.0


def test_a_loop_that_is_unstable_makes_no_move() -> None:
    servo = st.Servo.preset("paper")
    assert move_time(servo, servo.controller.replace(Kp=3.0 * servo.controller.Kp), 0.0, 1e-3, 20.0) == 0.0


def test_a_servo_a_thousand_times_slower_takes_a_thousand_times_as_long() -> None:
    servo, units = st.Servo.preset("paper"), Units(time=1e3)
    slow = scaled(servo, *units)
    taken = [move_time(each, each.controller, 0.0, 1e-3, 10.0 * second) for each, second in ((servo, 1.0), (slow, 1e3))]
    assert taken[1] == pytest.approx(1e3 * taken[0], rel=1e-2)


@pytest.mark.parametrize("name", ["telescope", "robot-joint", "stepper-stage", "emps"])
def test_the_windows_of_an_axis_in_other_units_last_as_long(name: str) -> None:
    axis, units = st.Axis.preset(name), AxisUnits(time=2.0**-10, length=2.0**20, torque=2.0**6)
    lasted = []
    for each, time, length in ((axis, 1.0, 1.0), (scaled_axis(axis, units), units.time, units.length)):
        # A rotary load counts angles.
        size = 2.5e-3 * (1.0 if axis.load.motion == "rotary" else length)
        twin = TwinSettings(policy="paper", uncertainty=Uncertainty().replace(step=(0.04 * size, size)))
        found = Commissioning(each, each.controller, twin, Recording(each.controller.sample_rate))
        lasted.append((found.window / time, found.pre_trigger / time))
    assert lasted[1] == pytest.approx(lasted[0], rel=1e-6)


def edge(window: float | None = None) -> Commissioning:
    return Commissioning(OWN, RACK.controller, TwinSettings(policy="paper", k_dz=0.0), Recording(4000.0, window))


@pytest.mark.slow
def test_windows_of_a_slow_loop_contain_where_the_load_is_slowed_down() -> None:
    """With the machine's own time they would end before the motor touches the other flank."""
    run = st.simulate(RACK, 4.0, reference=st.SquareWave(5e-3, 4.0), gap=math.radians(0.5), sample_rate=4000.0)
    before, lengths = edge().pre_trigger, (2.0 * scales(OWN).time, edge().window)
    found = [st.estimate_gap(st.Window.from_run(run, 2.0 - before, each), RACK).status for each in lengths]
    assert found == [st.GapStatus.LOWER_BOUND, st.GapStatus.OK]


def test_a_window_that_is_given_stays() -> None:
    assert edge(0.05).window == 0.05


def test_the_twin_may_request_windows_of_a_slow_loop_twice_as_long() -> None:
    slow = edge().with_longest(4.0, 0.3, 250_000)
    assert slow.recording.longest_window == pytest.approx(2.0 * edge().window)
