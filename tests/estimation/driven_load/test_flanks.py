"""A load that rolls on at its motor's reversals is not on the flank that play says."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import recording

from servotwin.control.controller import Controller
from servotwin.estimation.driven_load.answer import gap_of_recording
from servotwin.estimation.driven_load.flanks import parts_without_pause, share_on_other_flank
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.plant.actuator import TorqueDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import ROTARY, Load
from servotwin.plant.transmission import FREE, HELD, Transmission

GAP = 0.05  # rad at the motor, whose load turns a tenth


def axis(friction, drag=0.0, force=0.0, in_gap=FREE):
    """2 kg m^2 on a stiff shaft: the motor accelerates them by up to 7 rad/s^2."""
    shaft = Transmission(0.1, 1e6, 0.0 if in_gap == HELD else 1.0, in_gap=in_gap)
    load = Load((2.0,), (0.0,), (drag,), ROTARY, friction=friction, force=force)
    return Axis(TorqueDrive(1.0), shaft, load, Controller(0, 0, 0, 1.0))


@pytest.fixture(scope="module")
def made():
    return recording(gap=GAP)


@pytest.fixture(scope="module")
def lost(made):
    found = estimate_lost_motion(made)
    assert found.ok
    return found


def test_a_load_that_friction_holds_shows_its_gap(made, lost):
    found = gap_of_recording(made, lost, axis(friction=20.0))
    assert found.ok
    assert share_on_other_flank(made, lost, axis(friction=20.0)) == 0.0


@pytest.mark.parametrize("friction", [0.0, 1.0])
def test_a_load_that_rolls_on_is_no_gap_however_well_play_fits(made, lost, friction):
    # A drive of 5.6 kg m^2 without friction: 0.0316 to 0.0341 rad, ok, for 0.0195 rad.
    found = gap_of_recording(made, lost, axis(friction))
    assert found.status is GapStatus.MODEL_MISMATCH
    assert "the inertia of --axis's load is larger than its friction" in " ".join(found.reasons)
    low, high = found.interval_motor
    assert low == 0.0
    assert high >= lost.interval_motor[1]


def test_drag_and_weight_hold_a_load_too(made, lost):
    # Without drag each stroke brakes for half of its time; a weight presses on one flank all the time.
    assert share_on_other_flank(made, lost, axis(0.0)) == pytest.approx(0.5, abs=0.1)
    assert share_on_other_flank(made, lost, axis(0.0, drag=20.0)) < 0.3
    assert share_on_other_flank(made, lost, axis(0.0, force=100.0)) == pytest.approx(0.5, abs=0.1)


def test_a_motor_that_counts_backwards_and_pauses_change_nothing(made, lost):
    rows = np.delete(np.arange(made.time.size), np.s_[4000:4600])
    paused = replace(made, **{name: getattr(made, name)[rows] for name in ("time", "motor", "load")})
    assert [len(each) for each in parts_without_pause(paused)] == [4000, made.time.size - 4600]
    turned, against = replace(made, motor=-made.motor), replace(lost, ratio=-lost.ratio)
    whole = share_on_other_flank(made, lost, axis(1.0))
    assert share_on_other_flank(turned, against, axis(1.0)) == pytest.approx(whole)
    assert share_on_other_flank(paused, lost, axis(1.0)) == pytest.approx(whole, abs=0.05)


def test_stretches_of_a_thinned_log_count_alone(made, lost):
    alone = np.arange(made.time.size) // 1000 % 2 == 1
    parts = parts_without_pause(replace(made, alone=alone))
    assert [len(each) for each in parts] == [1000] * 5
    assert not any(alone[each].any() for each in parts)
    share = share_on_other_flank(replace(made, alone=alone), lost, axis(0.0))
    assert share == pytest.approx(0.5, abs=0.15)


def test_a_shaft_that_is_held_in_its_gap_is_no_load_that_rolls(made, lost):
    assert gap_of_recording(made, lost, axis(1.0, in_gap=HELD)).ok
