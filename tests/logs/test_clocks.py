"""Clocks of logs: times of day over midnight, an hour that came twice, epochs, units."""

import numpy as np
import pytest
from recordings import recording
from typer.testing import CliRunner

from servotwin.cli.app import app
from servotwin.errors import InvalidInput
from servotwin.logs import csv_file
from servotwin.logs.clocks import HOURS_BACK, MIDNIGHTS, WHOLE, LogClock
from servotwin.logs.dates import time_of
from servotwin.logs.names import known_unit, named_unit
from servotwin.logs.recordings import RecordingColumns, read_recording

MADE = recording(gap=0.05, ratio=0.1, seconds=6.0, rate=200.0)
DAY, HOUR = 86400.0, 3600.0


def written(path, stamps, head="time"):
    rows = [f"{t},{m:.6f},{x:.6f}" for t, m, x in zip(stamps, MADE.motor, MADE.load, strict=True)]
    path.write_text("\n".join([f"{head},motor [rad],load [mm]", *rows, ""]))
    return path


def of_day(seconds):
    seconds = seconds % DAY
    return f"{int(seconds // HOUR):02d}:{int(seconds % HOUR // 60):02d}:{seconds % 60:06.3f}"


@pytest.mark.parametrize("block", [10_000, 250])
@pytest.mark.parametrize(
    ("stamps", "defect"),
    [
        ([of_day(DAY - 2.0 + t) for t in MADE.time], MIDNIGHTS),
        ([f"{(DAY - 2.0 + t) % DAY:.3f}" for t in MADE.time], MIDNIGHTS),
        ([f"2026-10-25 {of_day(3 * HOUR - 2.0 + t - HOUR * (t >= 2.0))}" for t in MADE.time], HOURS_BACK),
    ],
)
def test_a_clock_on_the_wall_loses_no_sample(tmp_path, monkeypatch, stamps, defect, block):
    monkeypatch.setattr(csv_file, "_ROWS", block)
    log = read_recording(written(tmp_path / "log.csv", stamps), RecordingColumns())
    assert log.recording.time.size == MADE.time.size
    assert np.allclose(np.diff(log.recording.time), np.diff(MADE.time), atol=1e-6)
    assert log.found == {defect: 1}


def test_a_day_is_not_counted_twice_where_single_stamps_are_wrong():
    times = np.arange(DAY - 3.0, DAY + 3.0, 0.5) % DAY
    times[2], times[8] = np.nan, DAY - 0.1
    clock = LogClock("log", "", None)
    found = clock.seconds(times, times.size)
    assert np.isnan(found[2])
    assert found[-1] - found[0] == 5.5


@pytest.mark.parametrize(
    ("unit", "begin", "name"),
    [
        (1e-3, 0.0, "ms since 1970"),
        (1e-6, 0.0, "us since 1970"),
        (1e-9, 0.0, "ns since 1970"),
        (DAY, -25569.0 * DAY, "spreadsheets"),
        (DAY, -719529.0 * DAY, "MATLAB"),
    ],
)
def test_times_without_a_unit_count_from_a_known_date(tmp_path, unit, begin, name):
    stamps = [f"{(time_of('2026-03-01 08:00:00') - begin + t) / unit:.11f}" for t in MADE.time]
    log = read_recording(written(tmp_path / "log.csv", stamps), RecordingColumns())
    assert log.recording.time[0] == pytest.approx(time_of("2026-03-01 08:00:00"), abs=0.01)
    assert np.ptp(log.recording.time) == pytest.approx(np.ptp(MADE.time), abs=1e-3)
    assert [name in defect for defect in log.found] == [True]


def test_times_of_reversals_count_from_the_first_sample_of_a_dated_log(tmp_path):
    path = written(tmp_path / "log.csv", [f"{1.7e12 + 1e3 * t:.0f}" for t in MADE.time])
    said = CliRunner().invoke(app, ["identify", str(path)]).stdout
    assert "times in ms since 1970" in said
    assert "1.7e+09" not in said


@pytest.mark.parametrize("first", [0.0, 46_000.0, 1.7e9])
def test_seconds_stay_seconds(first):
    times = first + MADE.time
    assert np.array_equal(LogClock("log", "", None).seconds(times, times.size), times)


def test_whole_numbers_without_a_unit_are_remarked_on_and_may_be_milliseconds(tmp_path):
    path = written(tmp_path / "log.csv", [f"{1e3 * t:.0f}" for t in MADE.time])
    said = read_recording(path, RecordingColumns())
    assert said.found == {WHOLE: MADE.time.size}
    assert np.ptp(said.recording.time) == pytest.approx(1e3 * np.ptp(MADE.time))
    stated = read_recording(path, RecordingColumns(time_unit="ms"))
    assert stated.found == {}
    assert np.allclose(stated.recording.time, MADE.time)
    with pytest.raises(InvalidInput, match="--time-unit 'ms' and --rate 200: give one of the two"):
        read_recording(path, RecordingColumns(time_unit="ms", rate=200.0))


def test_steps_of_a_quarter_of_an_hour_are_no_clock_set_back():
    clock = LogClock("log", "", None)
    times = 900.0 * np.arange(50.0)
    assert np.array_equal(clock.seconds(times, times.size), times)
    assert HOURS_BACK not in clock.found


def test_units_of_time(tmp_path):
    hours = [f"{t / HOUR:.10f}" for t in MADE.time]
    log = read_recording(written(tmp_path / "log.csv", hours, "time [h]"), RecordingColumns())
    assert np.ptp(log.recording.time) == pytest.approx(np.ptp(MADE.time), abs=1e-5)
    with pytest.raises(InvalidInput, match=r"times in 'weeks': allowed are s, ms, us, ns, min, h, d"):
        read_recording(written(tmp_path / "b.csv", MADE.time, "time [weeks]"), RecordingColumns())


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("Weg [\u03bcm]", "µm"),
        ("motor / °", "°"),
        ("load /mm", "mm"),
        ("motor [Degrees]", "deg"),
        ("load [inch]", "in"),
        ("tilt, arcsec", "arcsec"),
        ("torque [Nm]", "Nm"),
        ("a/b", ""),
    ],
)
def test_units_in_other_words(name, unit):
    assert named_unit(name) == unit
    assert known_unit(unit) == unit
