"""Recordings of which no gap can be read, because they are not of one machine throughout."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.breaks import largest_step
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion


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
