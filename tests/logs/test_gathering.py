"""Logs that come in blocks."""

import numpy as np
import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.logs import csv_file
from servotwin.logs.gathering import PARTED, THINNED, Gathering
from servotwin.logs.log import read_blocks, read_columns

TURN = {"motor": 2.0 * np.pi}


@pytest.fixture(scope="module")
def made():
    return recording(seconds=12.0, rate=400.0)


def gathered(made, size, motor=None, most=10**9):
    gathering = Gathering(TURN, most)
    motor = made.motor if motor is None else motor
    for begin in range(0, made.time.size, size):
        part = slice(begin, begin + size)
        gathering.add(made.time[part], {"motor": motor[part], "load": made.load[part]})
    return gathering.cleaned()


@pytest.mark.parametrize("size", [7, 100, 10_000])
def test_blocks_give_the_whole_log(made, size):
    clean = gathered(made, size)
    assert np.array_equal(clean.time, made.time)
    assert np.array_equal(clean.channels["load"], made.load)
    assert not clean.found


def test_an_angle_that_wraps_goes_on_from_block_to_block(made):
    whole = gathered(made, 500, made.motor % (2.0 * np.pi))
    turns = (whole.channels["motor"] - made.motor) / (2.0 * np.pi)
    assert np.allclose(turns, np.round(turns[0]), atol=1e-6)


def test_an_angle_that_does_not_wrap_keeps_its_turns(made):
    # Samples so far apart that a block ends more than half a turn before the next begins.
    sparse = slice(None, None, 60)
    gathering = Gathering(TURN)
    time, motor = made.time[sparse], 5.0 * made.motor[sparse]
    for begin in range(0, time.size, 10):
        part = slice(begin, begin + 10)
        gathering.add(time[part], {"motor": motor[part]})
    assert np.array_equal(gathering.cleaned().channels["motor"], motor)


def test_a_block_that_begins_before_the_last_one_ended_is_cut(made):
    gathering = Gathering({})
    for part in (slice(0, 1000), slice(900, 2000)):
        gathering.add(made.time[part], {"motor": made.motor[part], "load": made.load[part]})
    clean = gathering.cleaned()
    assert np.array_equal(clean.time, made.time[:2000])
    assert clean.found == {"samples out of order in time": 100}


def test_a_thinned_log_keeps_its_turning_points_and_its_gap(made):
    clean = gathered(made, 600, most=1000)
    motor = clean.channels["motor"]
    assert clean.time.size <= 1000
    assert clean.found[THINNED] == made.time.size - clean.time.size
    assert (motor.min(), motor.max()) == (made.motor.min(), made.motor.max())
    thin = EncoderRecording(clean.time, motor, clean.channels["load"], motor_count=1e-3)
    low, high = estimate_lost_motion(thin).interval_motor
    assert low <= 0.05 <= high
    assert high - low < 0.01


@pytest.mark.parametrize("size", [500, 10_000])
def test_of_a_log_whose_turns_were_lost_in_a_pause_the_longest_part_stays(made, size):
    kept = np.delete(np.arange(made.time.size), np.s_[1500:2300])
    motor = 3.0 * made.motor
    broken = EncoderRecording(made.time[kept], motor[kept] % (2.0 * np.pi), made.load[kept])
    clean = gathered(broken, size)
    assert np.array_equal(clean.time, made.time[2300:])
    assert clean.found[PARTED] == 1500
    turns = (clean.channels["motor"] - motor[2300:]) / (2.0 * np.pi)
    assert np.allclose(turns, np.round(turns[0]), atol=1e-6)
    whole = gathered(EncoderRecording(made.time[kept], motor[kept], made.load[kept]), size)
    assert PARTED not in whole.found


def test_an_angle_whose_turns_cannot_be_counted_is_refused(made):
    fast = (70.0 * made.motor) % (2.0 * np.pi)  # up to 0.4 turns from sample to sample
    with pytest.raises(InvalidInput, match="its turns cannot be counted"):
        gathered(made, 10_000, fast)


def test_a_table_of_text_is_the_same_in_blocks(tmp_path, made, monkeypatch):
    path = tmp_path / "log.csv"
    lines = [f"{t:.6f},{m:.6f}" for t, m in zip(made.time[:1000], made.motor, strict=False)]
    lines[700] = "1.75,n/a"
    path.write_text("\n".join(["time_s,motor", *lines]) + "\n")
    whole = read_columns(path, ("time_s", "motor"))
    monkeypatch.setattr(csv_file, "_ROWS", 300)
    blocks = list(read_blocks(path, ("time_s", "motor")))
    assert len(blocks) == 4
    joined = np.concatenate([each.values["motor"] for each in blocks])
    assert np.array_equal(joined, whole.values["motor"], equal_nan=True)
    assert blocks[2].damaged == whole.damaged == {"motor": "line 702: 'n/a'"}
