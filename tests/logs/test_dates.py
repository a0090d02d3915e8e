"""Cells of tables: dates, times of day, numbers with separators, quoted names and units behind them."""

import numpy as np
import pytest
from recordings import recording

from servotwin.errors import InvalidInput
from servotwin.logs.csv_file import csv_blocks
from servotwin.logs.dates import time_of
from servotwin.logs.names import named_unit
from servotwin.logs.recordings import RecordingColumns, read_recording

MADE = recording(gap=0.05, ratio=0.1, seconds=2.0, rate=200.0)
DAY = float(np.datetime64("2026-03-25", "s").astype(np.int64))


@pytest.mark.parametrize(
    ("cell", "seconds"),
    [
        ("2026-03-25T08:00:00.25Z", DAY + 28800.25),
        ("2026/3/25 8:00:00", DAY + 28800.0),
        ("25.03.2026 08:00:00,25", DAY + 28800.25),
        ("03/25/2026 08:00:00.25 PM", DAY + 72000.25),
        ("25/03/2026 08:00", DAY + 28800.0),
        ("12:00:01 AM", 1.0),
        ("23:59:59.5", 86399.5),
        ("08:00:01:250", 28801.25),
        ("2026-03-25T08:00:00.25+01:00", DAY + 25200.25),
        ("2026-03-25 08:00:00 -0530", DAY + 48600.0),
        ("25-Mar-2026 08:00:00", DAY + 28800.0),
        ("2026-03-25", DAY),
        ("25.03.2026", DAY),
    ],
)
def test_dates_and_times_of_day(cell, seconds):
    assert time_of(cell) == pytest.approx(seconds)


@pytest.mark.parametrize(
    "cell", ["12", "2026-13-01 00:00:00", "30.02.2026 00:00:00", "25:00:00", "8:61:00", "a:bc", "1-Foo-2026 08:00:00"]
)
def test_anything_else_is_none(cell):
    assert time_of(cell) is None


def written(path, head, separator, cells):
    rows = [separator.join(form(value) for form, value in zip(cells, row, strict=True)) for row in TABLE]
    path.write_text("\n".join([head, *rows, ""]), encoding="utf-8")
    return read_recording(path, RecordingColumns())


TABLE = list(zip(MADE.time, MADE.motor, MADE.load, strict=True))
PLAIN, GERMAN = "{:.6f}".format, lambda value: f"{value:,.6f}".translate(str.maketrans(".,", ",."))


def dated(value):
    return f"25.03.2026 08:00:{value:09.6f}"


@pytest.mark.parametrize(
    ("head", "separator", "cells", "scale"),
    [
        ("timestamp;motor [rad];load [mm]", ";", (dated, PLAIN, PLAIN), 1.0),
        ('"time, s","motor, rad","load, mm"', ",", (PLAIN, PLAIN, PLAIN), 1.0),
        ("time [s];motor [mrad];load [mm]", ";", (PLAIN, lambda value: f"{1e3 * value:,.3f}", PLAIN), 1e3),
        ("time [s];motor [mrad];load [mm]", ";", (GERMAN, lambda value: GERMAN(1e3 * value), GERMAN), 1e3),
    ],
)
def test_tables_of_spreadsheets(tmp_path, head, separator, cells, scale):
    log = written(tmp_path / "log.csv", head, separator, cells)
    assert not log.found
    assert log.recording.motor == pytest.approx(scale * MADE.motor, abs=1e-3)
    assert log.recording.load == pytest.approx(MADE.load, abs=1e-5)
    assert log.recording.load_unit == "mm"
    assert np.ptp(log.recording.time) == pytest.approx(np.ptp(MADE.time), abs=1e-5)


def test_text_in_place_of_all_numbers_is_told_with_its_line(tmp_path):
    with pytest.raises(InvalidInput, match=r"line 2: '1\.\d+ rad' is no number: write numbers, .*units in the header"):
        written(tmp_path / "log.csv", "time,motor,load", ",", (PLAIN, "{:.6f} rad".format, "{:.6f} mm".format))


@pytest.mark.parametrize(("name", "unit"), [("motor, rad", "rad"), ("Weg / mm", "mm"), ("a, b", ""), ("load", "")])
def test_a_unit_behind_a_comma(name, unit):
    assert named_unit(name) == unit


def test_comments_and_blank_lines_between_rows_are_left_out_and_lines_are_counted_with_them(tmp_path):
    rows = [f"{t:.6f},{m:.6f},{x:.6f}" for t, m, x in TABLE]
    rows[100:100] = ["", "# stopped for a coffee", "   "]
    rows[200] = rows[200].rpartition(",")[0] + ",broken"
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time,motor,load", *rows, "", ""]))
    log = read_recording(path, RecordingColumns())
    assert log.found == {"samples without a number in some column": 1}
    assert log.recording.time.size == MADE.time.size - 1
    assert next(csv_blocks(path, ["load"])).damaged == {"load": "line 202: 'broken'"}


def test_a_day_and_a_time_of_day_in_two_columns_and_rows_shorter_than_their_names(tmp_path):
    path = tmp_path / "log.csv"
    rows = [f"2026-03-25,08:00:{t:09.6f},{m:.6f},{x:.6f}" for t, m, x in TABLE]
    above = ["Some instrument", "Version,2", "", "Date,Time,motor [rad],load [mm],Comment"]
    path.write_text("\n".join([*above, *rows, ""]))
    log = read_recording(path, RecordingColumns())
    assert log.recording.load_unit == "mm"
    assert log.recording.time[0] == 28800.0
    assert log.recording.time.size == MADE.time.size
