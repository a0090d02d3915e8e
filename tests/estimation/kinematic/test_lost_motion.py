"""The gap between two encoders, without a model of the dynamics."""

import math
from dataclasses import replace

import numpy as np
import pytest
from recordings import recording, short_strokes, swings

from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.strokes import play_and_side
from servotwin.plant.backlash import play


@pytest.mark.parametrize("gap", [0.002, 0.05, 0.7, 6.0])
def test_from_two_counts_to_most_of_the_travel(gap):
    found = estimate_lost_motion(recording(gap=gap))
    low, high = found.interval_motor
    assert found.ok, found.reasons
    assert low <= gap <= high
    assert high - low < 0.02 * gap + 1.5e-3
    assert found.at_load == pytest.approx(0.1 * found.at_motor, rel=1e-3)


def test_zeros_that_are_many_turns_away_change_nothing():
    # An absolute encoder of 32 bits, a slide a kilometre from its origin: the digits of the motion got lost in sums.
    near = recording()
    found = estimate_lost_motion(near)
    far = estimate_lost_motion(replace(near, motor=near.motor + 1e6, load=near.load - 1e6))
    assert far.ok, far.reasons
    assert far.interval_motor == pytest.approx(found.interval_motor, rel=1e-2)
    assert np.ptp(far.curves.lead) == pytest.approx(np.ptp(found.curves.lead), rel=1e-2)
    assert far.curves.load == pytest.approx(found.curves.load - 1e6)


def test_a_lag_is_told_from_the_gap():
    found = estimate_lost_motion(recording(lag=5e-3))
    assert found.ok
    assert found.at_motor == pytest.approx(0.05, abs=3e-4)
    assert found.lag == pytest.approx(5e-3, rel=0.02)


@pytest.mark.slow
def test_a_load_that_runs_ahead_of_its_motor_is_doubted():
    # Inertia does that, or a motor's column that is late: the log does not tell which.
    found = estimate_lost_motion(recording(lag=-12e-3))
    assert found.status is GapStatus.MODEL_MISMATCH
    assert "ms ahead of the motor" in found.reasons[0]
    assert found.interval_motor[0] == 0.0
    assert found.interval_motor[1] > 0.05
    assert estimate_lost_motion(recording(lag=-2e-3)).ok


@pytest.mark.slow
def test_a_long_lag_of_a_fast_motion_is_no_wind_up_by_acceleration():
    # Its column is right to first order; what is left was taken for wind-up, and gap and wind-up looked alike.
    found = estimate_lost_motion(recording(lag=12e-3, speed=4.0, rate=1000.0, seconds=60.0))
    assert (found.model, found.status) == ("lag", GapStatus.OK)
    assert found.lag == pytest.approx(12e-3, rel=2e-3)
    assert found.at_motor == pytest.approx(0.05, abs=3e-4)


def test_a_cyclic_error_of_unknown_period():
    found = estimate_lost_motion(recording(error=lambda angle: 4e-4 * np.sin(angle / 0.13 + 1.0)))
    assert "cyclic" in found.model
    assert any(period == pytest.approx(2.0 * math.pi * 0.13, rel=0.03) for period in found.cycles)
    low, high = found.interval_motor
    assert low <= 0.05 <= high


def test_without_a_gap_none_is_claimed():
    found = estimate_lost_motion(recording(gap=0.0))
    assert found.status is GapStatus.UNIDENTIFIABLE
    assert found.interval_motor[0] == 0.0
    assert found.interval_motor[1] < 2e-3
    assert "at most" in found.reasons[0]


def test_a_load_that_never_follows_is_a_bound():
    time, motor = swings()
    found = estimate_lost_motion(EncoderRecording(time, motor, np.full(time.size, 0.3)))
    assert found.status is not GapStatus.OK
    assert not math.isfinite(found.interval_motor[1])


def test_a_load_that_hunts_follows_all_the_same():
    # 3.3 samples a period: from sample to sample it moves as noise does.
    time, motor = swings()
    found = estimate_lost_motion(EncoderRecording(time, motor, 0.1 * play(motor, 2.0) + 0.15 * np.sin(950.0 * time)))
    assert found.status is not GapStatus.LOWER_BOUND
    resting = 0.3 + 1e-3 * np.random.default_rng(5).standard_normal(time.size)
    assert estimate_lost_motion(EncoderRecording(time, motor, resting)).status is GapStatus.LOWER_BOUND


@pytest.mark.slow
def test_a_load_that_overshoots_at_every_reversal_shows_no_gap():
    # All cycles agree on the least gap, 0: there is no spread to search within.
    time, motor = swings()
    load = 0.1 * motor + 0.01 * np.tanh(10.0 * np.gradient(motor, time))
    found = estimate_lost_motion(EncoderRecording(time, motor, load))
    assert math.isfinite(found.ratio)
    assert found.status in (GapStatus.UNIDENTIFIABLE, GapStatus.MODEL_MISMATCH)


@pytest.mark.parametrize("shift", [0.0, 0.7, 1.9, 3.1])
def test_a_short_recording_gives_no_false_bound(shift):
    time = np.arange(0.0, 4.5, 0.002)
    motor = 3.0 * np.sin(np.pi * time + shift) + 1.3 * np.sin(5.2 * time + 2.0 * shift)
    found = estimate_lost_motion(EncoderRecording(time, motor, 0.1 * play(motor, 0.2)))
    assert found.interval_motor[0] <= 0.2 <= found.interval_motor[1]


@pytest.mark.slow
def test_a_swinging_load_is_no_gap():
    # A resonance in place of a gap: y'' + 2 d w y' + w^2 y = w^2 r m.
    time, motor = swings()
    omega, load, state = 12.0, np.empty(time.size), np.zeros(2)
    step = time[1]
    for i in range(time.size):
        state[1] += step * (omega**2 * (0.1 * motor[i] - state[0]) - 2.0 * omega * 0.05 * state[1])
        state[0] += step * state[1]
        load[i] = state[0]
    found = estimate_lost_motion(EncoderRecording(time, motor, load))
    assert found.status is GapStatus.MODEL_MISMATCH
    assert math.isnan(found.at_motor)


def test_each_reversal_shows_where_the_gap_is_worn():
    time, motor = swings()
    # Twice the gap in the upper half of the travel.
    gap = 0.05 * (1.0 + 1.0 / (1.0 + np.exp(-4.0 * motor)))
    found = estimate_lost_motion(EncoderRecording(time, motor, 0.1 * play(motor, gap)))
    upper = np.median([each.gap for each in found.local if each.position > 0.15])
    lower = np.median([each.gap for each in found.local if each.position < -0.15])
    assert 0.05 < lower < 0.065
    assert 0.085 < upper < 0.1


def test_two_weightings_disagree_where_the_model_is_wrong():
    # The load lags by a constant way when it is fast only: neither gap nor lag, and no model has it.
    time, motor = swings()
    rate = np.gradient(motor, time)
    load = 0.1 * play(motor, 0.05) - 3e-3 * np.tanh(0.3 * rate) ** 3
    found = estimate_lost_motion(EncoderRecording(time, motor, load))
    assert found.status is GapStatus.MODEL_MISMATCH
    assert "if the motor's way does" in found.reasons[0]


@pytest.mark.parametrize(
    ("motor", "message"),
    [(lambda t: np.full(t.size, 1.0), "the motor moves by"), (lambda t: 0.3 * t, "reverses 0 times")],
    ids=["at rest", "one direction"],
)
def test_motions_that_show_nothing_are_refused(motor, message):
    time, _ = swings()
    with pytest.raises(InvalidInput, match=message):
        estimate_lost_motion(EncoderRecording(time, motor(time), 0.1 * motor(time)))


def test_play_is_the_play_operator_from_the_first_contact_on():
    _, motor = swings()
    side = np.zeros(motor.size, dtype=np.int8)
    output = play_and_side(motor, 0.4, side)
    known = side != 0
    assert np.array_equal(output[known], play(motor, 0.4)[known])
    assert set(np.unique(side)) == {-1, 0, 1}


@pytest.mark.slow
def test_intervals_cover():
    # Errors that are neither white nor Gaussian: a random walk of the offset, a cyclic error, counts.
    inside = accepted = 0
    for seed in range(12):
        generator = np.random.default_rng(100 + seed)
        made = recording(
            gap=0.08, noise=0.0, seconds=12.0, rate=100.0, seed=seed, error=lambda angle: 3e-4 * np.sin(7.0 * angle)
        )
        drift = np.cumsum(generator.standard_normal(made.time.size)) * 1e-5
        found = estimate_lost_motion(EncoderRecording(made.time, made.motor, made.load + drift))
        accepted += found.ok
        low, high = found.interval_motor
        inside += low <= 0.08 <= high
        # Student's quantile of 97.5 % for the number of cycles.
        assert not found.ok or 1.96 < 0.5 * (high - low) / found.std_motor < 4.4
    assert inside >= 11
    assert accepted >= 6


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "seed"), [(1.5, 4), (2.5, 1), (4.0, 3)])
def test_strokes_little_longer_than_the_gap_show_it_on_both_sides(amplitude, seed):
    # Before: 1.9973 +- 0.0006 rad for 2 rad, the end of a grid; 1.96 +- 0.1 rad; and, at the load, 3.198 mm for 3.2 mm.
    found = estimate_lost_motion(short_strokes(2.0, amplitude, seed))
    assert found.ok, found.reasons
    for (low, high), gap in ((found.interval_motor, 2.0), (found.interval_load, 3.2)):
        assert low <= gap <= high
        assert high - low < 4e-3 * gap


@pytest.mark.slow
def test_the_lag_that_is_told_is_that_of_the_final_fit():
    made = short_strokes(2.0, 2.5, 0)
    late = replace(made, load=np.interp(made.time - 3e-3, made.time, made.load))
    assert estimate_lost_motion(late).lag == pytest.approx(3e-3, abs=1e-4)


def test_curves_take_the_lag_off_and_have_their_least_error_at_the_gap():
    found = estimate_lost_motion(recording(lag=20e-3))
    curves = found.curves
    assert curves.gaps[np.argmin(curves.rms)] == pytest.approx(found.at_motor, rel=1e-6)
    assert curves.gaps[0] == 0.0
    # Before: the lag of 20 ms let the loop bulge by several gaps.
    assert np.ptp(np.quantile(curves.lead, (0.01, 0.99))) == pytest.approx(0.05, rel=0.1)


def test_a_gap_that_grows_within_the_log_is_said_to():
    made = recording(seconds=40.0, rate=200.0, noise=0.0, gap=0.0)
    half = 0.5 * np.linspace(0.03, 0.09, made.time.size)
    place, load = 0.0, np.empty(made.time.size)
    for row, motor in enumerate(made.motor):
        place = min(max(place, motor - half[row]), motor + half[row])
        load[row] = 0.1 * place
    found = estimate_lost_motion(replace(made, load=load))
    assert not found.ok
    assert "goes from 0.03" in found.reasons[0]
    assert "give the log in parts" in found.reasons[0]
