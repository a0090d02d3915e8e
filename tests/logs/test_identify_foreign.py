"""`servotwin identify` and `convert` on foreign logs: output, refusals, wear over several logs."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from recordings import csv, recording, rows
from typer.testing import CliRunner

from servotwin.cli.app import app
from servotwin.logs.recordings import RecordingColumns, read_recording

GAP, RATIO = 0.05, 0.1


@pytest.fixture(scope="module")
def made():
    return recording(gap=GAP, ratio=RATIO, seconds=12.0, rate=200.0)


def test_options_of_the_other_way_are_refused(tmp_path, made):
    path = csv(tmp_path / "a.csv", rows(made))
    result = CliRunner().invoke(app, ["identify", str(path), "--motor", "motor", "--start", "3"])
    assert result.exit_code == 2
    assert "need a model of the machine" in result.stderr


BAD = {
    "no such column": (("--motor", "moter_rad"), r"did you mean 'motor_rad'\?"),
    "no column like it": (("--time", "time_s"), "no column is named like the motor's position; give --motor COLUMN"),
    "one direction": ((), "the motor reverses 0 times in"),
    "words": ((), r"samples can be used, .* column 'motor_rad', line 2: 'slow'"),
    "empty": ((), "the file holds no row"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_log_is_one_sentence(tmp_path, made, kind):
    values = rows(made)[::4]
    path = csv(
        tmp_path / "log.csv", values, "time_s,a,b" if kind == "no column like it" else "time_s,motor_rad,load_rad"
    )
    if kind == "one direction":
        csv(path, np.column_stack([values[:, 0]] * 3))
    elif kind == "words":
        path.write_text("\n".join(["time_s,motor_rad,load_rad", *(f"{row[0]},slow,1" for row in values)]))
    elif kind == "empty":
        path.write_text("# nothing\n")
    options, message = BAD[kind]
    result = CliRunner().invoke(app, ["identify", str(path), *options])
    assert result.exit_code == 2
    assert result.stderr.count("\n") <= 1
    assert re.search(message, result.stderr)


def test_a_motor_in_counts_is_told_to_leave_the_lead_out(tmp_path, made):
    path = csv(tmp_path / "log.csv", rows(made), "t [s],motor [counts],load [mm]")
    result = CliRunner().invoke(app, ["identify", str(path), "--lead-mm", "5"])
    assert "motor in 'counts': with --lead-mm give --motor-unit" in result.stderr
    assert "of counts, leave --lead-mm out: the travel per count is fitted" in result.stderr


def test_identify_from_a_log_to_json(tmp_path, made):
    path = csv(tmp_path / "log.csv", rows(made), "t [s],motor [rad],load [mm]")
    result = CliRunner().invoke(app, ["identify", str(path), "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert (found["status"], found["unit_motor"], found["unit_load"]) == ("lost motion", "rad", "mm")
    low, high = found["lost_motion_interval_load"]
    assert low <= GAP * RATIO <= high
    assert found["lost_motion_motor"] == pytest.approx(GAP, abs=1e-3)
    assert (found["gap_load"], found["interval_load"]) == (None, [0.0, high])
    assert "give the machine (--axis), or --stiff" in found["reasons"][-1]
    assert len(found["segments"]) > 10


@pytest.mark.parametrize(
    ("scale", "header", "words"),
    [
        (1e-3, "t [s],motor [rad],load [m]", "gap 0.00{} mm at the load, 0.0{} rad at the motor"),
        (math.radians(1.0), "t [s],motor [rad],load [rad]", "gap 0.00{} deg at the load, {} deg at the motor"),
    ],
)
def test_people_read_millimetres_and_degrees(tmp_path, made, scale, header, words):
    path = csv(tmp_path / "log.csv", rows(replace(made, load=scale * made.load)), header)
    shown = " ".join(CliRunner().invoke(app, ["identify", str(path), "--stiff"]).output.split())
    assert re.search(words.replace("{}", r"[0-9.]+"), shown)
    found = json.loads(CliRunner().invoke(app, ["identify", str(path), "--stiff", "--json"]).stdout)
    assert found["gap_load"] == pytest.approx(scale * float(re.search(r"gap ([0-9.]+)", shown)[1]), rel=1e-3)
    assert f"[{found['unit_load']}]" == header.split("load ")[1]


def test_lost_motion_is_gap_only_where_nothing_winds_up(tmp_path, made):
    path = csv(tmp_path / "log.csv", rows(made), "t [s],motor [rad],load [mm]")
    unknown, stiff = (
        CliRunner().invoke(app, ["identify", str(path), *options]).output for options in ([], ["--stiff"])
    )
    assert re.search(
        r"lost motion 0\.00\d+ mm .* the gap is at most 0\.005\d+ mm; status: lost motion", " ".join(unknown.split())
    )
    assert re.search(r"gap 0\.00\d+ mm at the load, .*: ok", " ".join(stiff.split()))
    both = CliRunner().invoke(app, ["identify", str(path), "--stiff", "--axis", "ball-screw"])
    assert both.exit_code == 2
    assert "give one of the two" in both.stderr


def test_a_stated_travel_gives_a_load_without_a_unit_its_scale(tmp_path, made):
    # 0.1 per rad of the motor: 2 pi / 10 mm a turn, or ten turns for one.
    counts = replace(made, load=made.load / 3e-4)
    path = csv(tmp_path / "log.csv", rows(counts), "t [s],motor [rad],load")

    def found(*options):
        return json.loads(CliRunner().invoke(app, ["identify", str(path), "--json", *options]).stdout)

    plain, lead, ratio = found(), found("--lead-mm", str(0.2 * math.pi)), found("--ratio", "10")
    assert (plain["unit_load"], lead["unit_load"], ratio["unit_load"]) == ("load unit", "mm", "rad")
    for each in (lead, ratio):
        assert each["lost_motion_load"] == pytest.approx(0.1 * each["lost_motion_motor"], rel=1e-9)
        assert each["lost_motion_motor"] == pytest.approx(plain["lost_motion_motor"])
        assert each["rms_load"] / plain["rms_load"] == pytest.approx(3e-4, rel=1e-3)
        assert each["segments"][0]["position_load"] == pytest.approx(made.load[0], abs=1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--lead-mm", "0.9"), "that of --lead-mm by 0.000143.*: check the units of both columns"),
        (("--ratio", "10"), "load in 'mm': with --ratio give --load-unit, one of rad"),
        (("--ratio", "10", "--lead-mm", "1"), "give one of the two"),
        (("--ratio", "0"), "must be positive and finite"),
    ],
)
def test_a_stated_travel_that_is_not_the_log_s_is_refused(tmp_path, made, options, message):
    path = csv(tmp_path / "log.csv", rows(made), "t [s],motor [rad],load [mm]")
    result = CliRunner().invoke(app, ["identify", str(path), *options])
    assert result.exit_code == 2
    assert re.search(message, " ".join(result.stderr.split()))


@pytest.mark.slow
def test_dates_of_files_and_of_one_day_are_no_wear(tmp_path):
    logs = [
        csv(tmp_path / f"{place}.csv", rows(recording(gap=gap, ratio=RATIO, seconds=8.0, rate=100.0)))
        for place, gap in enumerate((0.05, 0.055, 0.06))
    ]
    plain = CliRunner().invoke(app, ["identify", *map(str, logs)])
    assert "no growth per year: the dates of files are not those of recordings" in " ".join(plain.output.split())
    rows_of = json.loads(CliRunner().invoke(app, ["identify", *map(str, logs), "--json"]).stdout)
    assert {each["date_from"] for each in rows_of} == {"file"}
    assert "growth_per_year_load" not in rows_of[-1]
    mixed = CliRunner().invoke(
        app,
        [
            "identify",
            str(logs[0]),
            str(csv(tmp_path / "mm.csv", rows(recording()), "time_s,motor_rad,load_mm")),
            "--json",
        ],
    )
    assert mixed.exit_code == 2
    assert "its load is in mm" in mixed.stderr


@pytest.mark.slow
def test_a_page_of_the_gap(tmp_path, made):
    log = csv(tmp_path / "log <b>.csv", rows(made))
    result = CliRunner().invoke(app, ["identify", str(log), "--page", str(tmp_path / "gap.html")])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "gap.html").read_text()
    assert "log &lt;b&gt;.csv" in text
    assert "<b>" not in text
    assert text.count("data:image/svg+xml") == 4
    wrong = CliRunner().invoke(app, ["identify", str(log), "--page", str(tmp_path / "gap.pdf")])
    assert wrong.exit_code == 2
    assert ".html" in wrong.stderr


def test_the_change_between_two_logs(tmp_path, made):
    first = csv(tmp_path / "old.csv", rows(made))
    worn = recording(gap=0.06, ratio=RATIO, seconds=12.0, rate=200.0, seed=2)
    second = csv(tmp_path / "new.csv", rows(worn))
    result = CliRunner().invoke(app, ["identify", str(first), str(second)])
    assert result.exit_code == 0, result.output
    assert "change of the lost motion: +0.057" in " ".join(result.output.split())
    assert "(95 %): more than chance explains" in " ".join(result.output.split())


def test_a_foreign_log_is_converted_without_its_defects(tmp_path, made):
    values = rows(made)
    values[100, 2] = np.nan
    path = csv(tmp_path / "log.csv", values, "t,qa,qb\ns,rad,um", ";")
    options = ["--motor", "qa", "--load", "qb"]
    result = CliRunner().invoke(app, ["convert", str(path), str(tmp_path / "clean.npz"), *options])
    assert result.exit_code == 0, result.output
    assert "samples without a number in some column: 1" in result.output
    log = read_recording(tmp_path / "clean.npz", RecordingColumns())
    assert (log.recording.motor_unit, log.recording.load_unit) == ("rad", "um")
    assert not log.found
    assert np.allclose(log.recording.motor, np.delete(made.motor, 100), atol=1e-8)


@pytest.mark.slow
def test_wear_over_three_logs_in_calendar_time(tmp_path):
    logs = []
    for month, gap in (("01", 0.05), ("04", 0.055), ("07", 0.06)):
        one = recording(gap=gap, ratio=RATIO, seconds=8.0, rate=200.0)
        # Time stamps since 1970 are dates.
        begin = np.datetime64(f"2026-{month}-01", "s").astype(float)
        logs.append(csv(tmp_path / f"{month}.csv", rows(one)))
        lines = [f"{begin + t:.3f},{m:.9g},{x:.9g}" for t, m, x in rows(one)]
        logs[-1].write_text("\n".join(["time_s,motor_rad,load_rad", *lines]))
    result = CliRunner().invoke(app, ["identify", *map(str, logs), "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert [each["date"][:10] for each in found] == ["2026-01-01", "2026-04-01", "2026-07-01"]
    assert found[-1]["growth_of"] == "lost motion"
    assert found[-1]["growth_per_year_load"] == pytest.approx(0.01 * RATIO * 365.25 / 181, rel=0.05)
    for dates in (",,", "NaT,NaT,NaT", "2026-01-01,20280,2026-03-01"):
        wrong = CliRunner().invoke(app, ["identify", *map(str, logs), "--dates", dates])
        assert wrong.exit_code == 2
        assert "give dates such as 2026-03-01" in wrong.stderr
    wrong = CliRunner().invoke(app, ["identify", *map(str, logs), "--dates", "2026-01-01"])
    assert wrong.exit_code == 2
    assert "has 1 dates for 3 logs" in wrong.stderr


@pytest.mark.parametrize("times", [2, 4, 10])
def test_a_load_that_was_held_gives_the_gap_as_ever(made, tmp_path, times):
    every = np.arange(made.time.size) // times * times
    log = csv(tmp_path / "held.csv", zip(made.time, made.motor, made.load[every], strict=True))
    result = CliRunner().invoke(app, ["identify", str(log), "--json", "--stiff"])
    assert result.exit_code == 0, result.output
    low, high = json.loads(result.stdout)["interval_load"]
    assert low <= GAP * RATIO <= high
