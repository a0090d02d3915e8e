"""Recordings of which no gap can be read, because they are not of one machine throughout."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.breaks import check_not_joined, largest_step
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording


def broken(change):
    made = recording(seconds=12.0, rate=200.0)
    load = made.load.copy()
    half = load.size // 2
    load[half:] = change(load[half:])
    return replace(made, load=load)


def test_a_slipped_encoder_is_told_with_its_time():
    with pytest.raises(InvalidInput, match=r"from 6 s on the load is \+0.02 rad off .* slipped"):
        estimate_lost_motion(broken(lambda load: load + 0.02))


def test_two_machines_in_one_log_are_told():
    with pytest.raises(
        InvalidInput, match=r"by 0\.099\d+ rad per rad in its first half and by 0\.1998 in its second: two"
    ):
        estimate_lost_motion(broken(lambda load: 2.0 * load))


def test_a_drift_much_smaller_than_the_gap_is_none():
    assert np.isfinite(estimate_lost_motion(broken(lambda load: load + 2e-4)).at_motor)


def test_a_load_that_swings_further_on_faster_strokes_is_one_machine():
    time = np.arange(0.0, 24.0, 5e-3)
    speed = 4.0 + np.tanh(2.0 * (time - 12.0)) * 2.0
    motor = 5.0 * np.sin(np.cumsum(speed) * 5e-3)
    load = 0.1 * (motor - 2.5e-3 * np.gradient(np.gradient(motor, time), time))
    made = replace(recording(seconds=24.0, rate=200.0), time=time, motor=motor, load=load)
    assert estimate_lost_motion(made).ratio == pytest.approx(0.1, rel=0.1)


def test_the_largest_step_of_a_residual():
    residual = np.where(np.arange(100) < 30, 1.0, 4.0)
    step = largest_step(residual)
    assert (step.row, step.size) == (30, pytest.approx(3.0))
    assert step.explained == pytest.approx(1.0)
    assert largest_step(np.zeros(5)).explained == 0.0


def joined(first, second):
    later = second.time + first.time[-1] + 0.01
    return EncoderRecording(
        *(
            np.concatenate(each)
            for each in ((first.time, later), (first.motor, second.motor), (first.load, second.load))
        )
    )


@pytest.mark.parametrize(
    ("offset", "ratio", "told"),
    [
        (5.0, 0.1, r"from 8.005 s on the load is \+5 rad off"),
        (-0.2, 0.1, r"from 8.005 s on the load is -0.\d+ rad off"),
        (0.0, 0.2, r"by 0\.\d+ rad per rad until 8.005 s and by 0\.\d+ from then on: two machines"),
        (0.0, 100.0, r"by 0\.\d+ rad per rad until 8.005 s and by \d+.* from then on: two machines or units"),
    ],
)
def test_two_logs_that_were_joined_are_told_with_the_place(offset, ratio, told):
    # Before: a gap of 8.8 to 13 rad for 0.3 and 0.1 rad, status ok.
    first = recording(seconds=8.0, rate=200.0)
    second = recording(seconds=8.0, rate=200.0, seed=2, gap=0.08, ratio=ratio, speed=1.3)
    with pytest.raises(InvalidInput, match=told):
        estimate_lost_motion(joined(first, replace(second, load=second.load + offset)))


def test_two_machines_by_turns_are_told():
    first, second = recording(seconds=8.0, rate=200.0), recording(seconds=8.0, rate=200.0, seed=2, speed=1.3)
    by_turns = [np.column_stack(each).ravel() for each in ((first.motor, second.motor), (first.load, second.load))]
    with pytest.raises(InvalidInput, match="the motor's position jumps to and fro from sample to sample: two machines"):
        estimate_lost_motion(EncoderRecording(np.arange(3200) * 2.5e-3, *by_turns))


@pytest.mark.parametrize("hunting", [0.0, 0.05])
def test_a_log_of_one_machine_with_dropouts_is_not_joined(hunting):
    made = recording(seconds=20.0, rate=200.0)
    kept = ~((made.time > 5.0) & (made.time < 7.3)) & ~((made.time > 12.0) & (made.time < 12.4))
    load = made.load + hunting * np.sin(40.0 * made.time)
    check_not_joined(replace(made, time=made.time[kept], motor=made.motor[kept], load=load[kept]))
    # The same dropouts are looked at: elsewhere behind one of them, the load is told.
    load[made.time > 7.0] += 1.0
    with pytest.raises(InvalidInput, match=r"from 7.3 s on the load is \+(1|0.9\d*|1.0\d*) rad off"):
        check_not_joined(replace(made, time=made.time[kept], motor=made.motor[kept], load=load[kept]))
