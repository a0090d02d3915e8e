"""Pauses of a recording in which the motor may have reversed."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import recording

from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.pauses import behind_pauses
from servotwin.estimation.kinematic.recording import EncoderRecording

MADE = recording(seconds=40.0, lag=3e-3)


def without(made, kept):
    return replace(made, time=made.time[kept], motor=made.motor[kept], load=made.load[kept])


def dropouts(times, length):
    return ~np.any([(MADE.time > time) & (MADE.time < time + length) for time in times], axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.3, 8.0])
def test_dropouts_leave_the_lost_motion_what_it_is(length):
    # Before: "model mismatch" for many short ones, and an interval of ten times the width for a long one.
    found = estimate_lost_motion(without(MADE, dropouts(np.arange(2.0, 30.0, max(1.7, 2.0 * length)), length)))
    whole = estimate_lost_motion(MADE)
    (low, high), (least, most) = found.interval_motor, whole.interval_motor
    assert found.ok, found.reasons
    assert low <= 0.05 <= high
    assert high - low < 2.0 * (most - least)


@pytest.mark.slow
def test_a_jump_of_the_motor_is_a_pause_that_the_times_do_not_show():
    kept = dropouts([10.0], 5.3)
    joined = without(MADE, kept)
    times = np.arange(joined.time.size) * 2e-3
    found = estimate_lost_motion(replace(joined, time=times))
    assert found.ok, found.reasons
    assert found.at_motor == pytest.approx(0.05, abs=1e-3)


def test_only_pauses_that_may_hide_a_reversal_count():
    time = np.arange(0.0, 4.0, 1e-2)
    kept = (time < 1.0) | (time > 1.3)
    steady = EncoderRecording(time[kept], 2.0 * time[kept], time[kept])
    assert not behind_pauses(steady, 0.1).any()
    turned = EncoderRecording(time[kept], 2.0 * np.abs(time[kept] - 1.02), time[kept])
    behind = np.flatnonzero(behind_pauses(turned, 0.1))
    first = int(np.flatnonzero(time[kept] > 1.3)[0])
    assert (behind[0], behind[-1]) == (first - 5, first + 4)
    wide = behind_pauses(turned, 0.35)
    last = int(np.flatnonzero(wide)[-1])
    assert turned.motor[last + 1] - turned.motor[first] == pytest.approx(0.35, abs=0.021)
