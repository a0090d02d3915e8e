"""What logs of controls, historians and spreadsheets have in them: stamps, stand-stills and turns."""

import numpy as np
import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.logs.cleaning import cleaned
from servotwin.logs.outliers import frozen, outliers
from servotwin.logs.recordings import RecordingColumns, read_recording
from servotwin.logs.stamps import in_order
from servotwin.logs.wrapping import guessed_turn

MADE = recording(gap=0.05, ratio=0.1, seconds=12.0, rate=200.0)
PLAIN = RecordingColumns(motor_unit="rad", load_unit="rad")


def log_of(path, time=MADE.time, motor=MADE.motor, load=MADE.load, columns=PLAIN):
    np.savez(path / "log.npz", time=time, motor=motor, load=load)
    return read_recording(path / "log.npz", columns)


@pytest.mark.parametrize("place", [500, MADE.time.size - 1])
def test_one_time_stamp_far_ahead_costs_one_sample(tmp_path, place):
    time = MADE.time.copy()
    time[place] += 1e9
    log = log_of(tmp_path, time)
    assert log.recording.time.size == time.size - 1
    assert sum(log.found.values()) == 1


def test_a_value_whose_square_is_no_number_is_left_out(tmp_path):
    load = MADE.load.copy()
    load[700:703] = 1e200
    log = log_of(tmp_path, load=load)
    assert log.found == {"samples without a number in some column": 3}
    with pytest.raises(InvalidInput, match=r"0 of \d+ samples can be used"):
        log_of(tmp_path, load=1e200 * np.sign(MADE.load - 1e-9))


def test_a_clock_that_is_set_back_keeps_most_of_the_log():
    time = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(7.0, 20.0, 0.1)])
    kept = in_order(time)
    assert np.all(np.diff(time[kept]) >= 0.0)
    assert time.size - np.sum(kept) in (29, 30)


def test_the_newest_sample_may_come_first(tmp_path):
    log = log_of(tmp_path, MADE.time[::-1], MADE.motor[::-1], MADE.load[::-1])
    assert np.array_equal(log.recording.motor, MADE.motor)
    assert list(log.found) == ["samples of a log with the newest first, which was turned round"]


@pytest.mark.parametrize("stamp", [0.02, 1.0])
def test_stamps_that_are_coarser_than_the_samples_are_spread(tmp_path, stamp):
    log = log_of(tmp_path, np.floor(MADE.time / stamp + 1e-9) * stamp)
    assert log.recording.time.size == MADE.time.size
    assert np.allclose(log.recording.time, MADE.time, atol=1e-3)


def test_samples_that_were_written_twice_count_once(tmp_path):
    log = log_of(tmp_path, *(np.repeat(each, 2) for each in (MADE.time, MADE.motor, MADE.load)))
    assert log.recording.time.size == MADE.time.size
    assert log.found == {"samples at the time of the one before": MADE.time.size}


def test_one_stamp_for_all_samples_is_told(tmp_path):
    with pytest.raises(InvalidInput, match="its 2400 samples have one time stamp: give --rate"):
        log_of(tmp_path, 0.0 * MADE.time)


@pytest.mark.parametrize("part", ["motor", "load"])
def test_a_channel_that_stood_still_for_a_while_is_left_out_for_as_long(tmp_path, part):
    values = {"motor": MADE.motor, "load": MADE.load}
    held = values[part].copy()
    held[700:860] = held[700]
    log = log_of(tmp_path, **{**values, part: held})
    assert log.found == {
        f"samples of a {part} that stood still until it jumped": 159,
        "pauses longer than five intervals": 1,
    }


def test_excursions_of_a_few_samples_are_left_out():
    values = np.sin(np.linspace(0.0, 20.0, 2000))
    broken = values.copy()
    broken[0], broken[-1] = 50.0, -50.0
    broken[300:302], broken[900:930], broken[1200] = 9.0, 30.0, -30.0
    assert np.array_equal(np.flatnonzero(outliers(broken)), np.flatnonzero(broken != values))
    assert not outliers(values).any()


def test_pulses_of_a_command_are_not_called_spikes():
    """The kick of a derivative is no defect; the like of it in an encoder is."""
    time = np.arange(400.0)
    kicked = np.sin(time / 30.0)
    kicked[200] = 50.0
    found = [cleaned(time, {"motor": np.cos(time / 30.0), name: kicked}, {}).found for name in ("command", "load")]
    assert found == [{"samples in short pulses of command": 1}, {"samples in spikes of load": 1}]


def test_a_load_that_sticks_and_slips_did_not_stand_still():
    slips = np.floor(np.linspace(0.0, 40.0, 2000))
    assert not frozen(slips).any()
    assert not outliers(slips).any()


@pytest.mark.parametrize(
    ("turn", "count"), [(2.0 * np.pi, 0.0), (360.0, 0.0), (4096.0, 1.0), (65536.0, 1.0), (2880.0, 1.0), (50.0, 0.0)]
)
def test_jumps_show_the_turn_of_a_channel_that_wraps(turn, count):
    angle = 4.3 * turn * np.sin(np.linspace(0.0, 30.0, 20_000))
    wrapped = np.mod(np.round(angle / count) * count if count else angle, turn)
    assert guessed_turn(wrapped) == pytest.approx(turn, rel=1e-3)


def test_a_machine_that_steps_to_and_fro_does_not_wrap():
    time = np.linspace(0.0, 30.0, 3000)
    assert guessed_turn(np.sign(np.sin(time)) + 0.01 * np.sin(50.0 * time)) is None
    assert guessed_turn(np.sin(time)) is None
    spikes = np.sin(time)
    spikes[[100, 700, 2100]] = 9.0
    assert guessed_turn(spikes) is None


def test_counts_that_wrap_are_unwrapped_and_said_to(tmp_path):
    counts = np.round(MADE.motor * 4096 / (2.0 * np.pi))
    log = log_of(tmp_path, motor=np.mod(counts, 4096), columns=RecordingColumns(motor_unit="counts"))
    assert np.ptp(log.recording.motor - counts) == 0.0
    assert "turns of motor that were unwrapped (its jumps show a turn of 4096)" in log.found


def test_nothing_is_left_out_of_a_clean_log_for_its_stamps():
    assert not cleaned(MADE.time, {"motor": MADE.motor, "load": MADE.load}, {}).found
