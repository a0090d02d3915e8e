"""Foreign logs: every format, and what real ones have in them."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from recordings import recording
from typer.testing import CliRunner

from servotwin.cli.app import app
from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.logs.cleaning import cleaned
from servotwin.logs.columns import SignalTable
from servotwin.logs.log import read_log, write_log
from servotwin.logs.recordings import RecordingColumns, read_recording

GAP, RATIO = 0.05, 0.1


@pytest.fixture(scope="module")
def made():
    return recording(gap=GAP, ratio=RATIO, seconds=12.0, rate=200.0)


def rows(made):
    return np.column_stack([made.time, made.motor, made.load])


def csv(path, values, header="time_s,motor_rad,load_rad", separator=",", comma=False, comments=()):
    lines = [*comments, header.replace(",", separator)]
    lines += [separator.join(f"{value:.9g}" for value in row) for row in values]
    text = "\n".join(lines) + "\n"
    path.write_text(text.replace(".", ",") if comma else text)
    return path


def seen(path, made, columns=None):
    log = read_recording(path, columns or RecordingColumns())
    assert np.allclose(log.recording.motor, made.motor, atol=1e-8)
    assert np.allclose(log.recording.load, made.load, atol=1e-8)
    return log


def test_tables_of_text(tmp_path, made):
    values = rows(made)
    plain = seen(csv(tmp_path / "a.csv", values), made)
    assert (plain.recording.motor_unit, plain.recording.load_unit) == ("rad", "rad")
    german = seen(csv(tmp_path / "b.csv", values, separator=";", comma=True, comments=["# Prüfstand 7"]), made)
    assert german.recording.motor_unit == "rad"
    bracketed = seen(csv(tmp_path / "c.txt", values, "t [s],motor [deg],load (mm)", "\t"), made)
    assert (bracketed.recording.motor_unit, bracketed.recording.load_unit) == ("deg", "mm")
    units = csv(tmp_path / "d.csv", values, "t,qa,qb\ns,rad,um", ";")
    assert seen(units, made, RecordingColumns(motor="qa", load="qb")).recording.load_unit == "um"
    bare = tmp_path / "e.dat"
    np.savetxt(bare, values)
    seen(bare, made, RecordingColumns(time="col1", motor="col2", load="col3"))


def test_structures_records_and_matrices(tmp_path, made):
    from scipy.io import savemat

    fields = {"time": made.time, "motor": made.motor, "load": made.load}
    records = np.array(list(zip(*fields.values(), strict=True)), dtype=[(name, float) for name in fields])
    savemat(tmp_path / "a.mat", {"rec": {**fields, "note": "text"}})
    np.savez(tmp_path / "a.npz", rec=records, data=rows(made))
    np.save(tmp_path / "a.npy", records)
    np.save(tmp_path / "b.npy", rows(made))
    inside = RecordingColumns(time="rec/time", motor="rec/motor", load="rec/load")
    for name in ("a.mat", "a.npz"):
        seen(tmp_path / name, made, inside)
    seen(tmp_path / "a.npz", made, RecordingColumns(time="data[0]", motor="data[1]", load="data[2]"))
    seen(tmp_path / "a.npy", made)
    seen(tmp_path / "b.npy", made, RecordingColumns(time="col1", motor="col2", load="col3"))
    h5py = pytest.importorskip("h5py", reason="h5py is an extra: pip install 'servotwin[hdf5]'")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rec"] = records
    seen(tmp_path / "a.h5", made, inside)


def test_times_of_pandas(tmp_path, made):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is an extra: pip install 'servotwin[parquet]'")
    from pyarrow import parquet

    spans = (1e9 * made.time).round().astype("timedelta64[ns]")
    for name, stamps in (("a.parquet", spans), ("b.parquet", np.datetime64("2026-03-01", "ns") + spans)):
        parquet.write_table(pyarrow.table({"time": stamps, "motor": made.motor, "load": made.load}), tmp_path / name)
        assert np.ptp(seen(tmp_path / name, made).recording.time) == pytest.approx(np.ptp(made.time), abs=1e-6)


def test_other_encodings_prose_and_units(tmp_path, made):
    values = rows(made)
    text = "\n".join(
        ["Recorded by X, on rig 7", "t [s];Winkel [°];Weg [µm]", *(";".join(f"{x:.9g}" for x in row) for row in values)]
    )
    for encoding in ("latin-1", "utf-8-sig", "utf-16", "utf-16-le"):
        (tmp_path / "a.csv").write_bytes(text.encode(encoding))
        log = seen(tmp_path / "a.csv", made, RecordingColumns(motor="Winkel", load="Weg"))
        assert (log.recording.motor_unit, log.recording.load_unit) == ("°", "µm")
    named = np.column_stack([values, values[:, 1]])
    path = csv(tmp_path / "b.csv", named, "time_s,theta_m,position_mm,command_n_m")
    assert seen(path, made).columns["command"] == "command_n_m"


def test_a_converted_log_keeps_its_first_sample_and_its_metadata(tmp_path, made):
    columns = {"time_s": made.time, "position_m": made.load, "theta_m_rad": made.motor}
    described = {"servo": "k = [1, 2, 3]\nname = 'a, b, c'", "window_s": 1.0, "text": "d, e, f, g"}
    write_log(SignalTable(columns, described), tmp_path / "run.csv")
    log = read_log(tmp_path / "run.csv")
    assert log.whole.time.size == made.time.size
    assert log.metadata == described


@pytest.mark.parametrize("rate", [-5.0, 0.0, np.nan])
def test_a_rate_that_is_none_is_refused(tmp_path, made, rate):
    path = csv(tmp_path / "a.csv", rows(made), "timestamp,motor,load")
    with pytest.raises(InvalidInput, match=r"--rate .*: must be above 0 Hz"):
        read_recording(path, RecordingColumns(rate=rate))


def test_two_parquet_columns_of_one_name_are_refused(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    values = pyarrow.array([1.0, 2.0])
    parquet.write_table(pyarrow.Table.from_arrays([values] * 3, ["motor", "load", "motor"]), tmp_path / "a.parquet")
    with pytest.raises(InvalidInput, match="has two columns 'motor'"):
        read_recording(tmp_path / "a.parquet", RecordingColumns(rate=100.0))


def test_a_given_rate_takes_the_place_of_times(tmp_path, made):
    values = rows(made) * [1e3, 1.0, 1.0]
    path = csv(tmp_path / "a.csv", values, "timestamp,motor,load")
    assert read_recording(path, RecordingColumns(rate=200.0)).recording.time[-1] == pytest.approx(made.time[-1])
    with pytest.raises(InvalidInput, match="give one of the two"):
        read_recording(path, RecordingColumns(rate=200.0, time="timestamp"))


def test_options_of_the_other_way_are_refused(tmp_path, made):
    path = csv(tmp_path / "a.csv", rows(made))
    result = CliRunner().invoke(app, ["identify", str(path), "--motor", "motor", "--start", "3"])
    assert result.exit_code == 2
    assert "need a model of the machine" in result.stderr


def test_milliseconds(tmp_path, made):
    values = rows(made) * [1e3, 1.0, 1.0]
    log = seen(csv(tmp_path / "a.csv", values, "time_ms,motor,load"), made)
    assert np.allclose(log.recording.time, made.time)


def test_arrays_of_numpy_and_matlab(tmp_path, made):
    from scipy.io import savemat

    np.savez(tmp_path / "a.npz", time=made.time, motor=made.motor, load=made.load)
    seen(tmp_path / "a.npz", made)
    savemat(tmp_path / "b.mat", {"data": rows(made).T, "note": "text"})
    columns = RecordingColumns(time="data[0]", motor="data[1]", load="data[2]")
    seen(tmp_path / "b.mat", made, columns)
    with pytest.raises(InvalidInput, match=r"there is no such column .*it has data\[0\], data\[1\], data\[2\]"):
        read_recording(tmp_path / "b.mat", RecordingColumns(motor="date[1]"))


def test_hdf5_and_the_matlab_file_that_is_one(tmp_path, made):
    h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
    for name, userblock in (("a.h5", 0), ("b.mat", 512)):
        with h5py.File(tmp_path / name, "w", userblock_size=userblock) as file:
            file["axis/table"] = rows(made)
            file["axis/name"] = "rig"
        columns = RecordingColumns(time="axis/table[0]", motor="axis/table[1]", load="axis/table[2]")
        seen(tmp_path / name, made, columns)
    (tmp_path / "c.h5").write_bytes((tmp_path / "a.h5").read_bytes()[:3000])
    with pytest.raises(InvalidInput, match="is not an HDF5 file that can be read"):
        read_recording(tmp_path / "c.h5", RecordingColumns())


def test_events_of_epics(tmp_path, made):
    # Each variable reports when it changes, and the first line is the last value of yesterday.
    begin = np.datetime64("2026-03-01T08:00:00", "us")
    lines = [f"RIG:LOAD 2026-02-28 17:00:00.000000 {made.load[0]:.6f}"]
    for place, (time, motor, load) in enumerate(rows(made)):
        for name, value, offset in (("RIG:MOTOR", motor, 0.0), ("RIG:LOAD", load, 1e-3)):
            stamp = str(begin + np.timedelta64(round(1e6 * (time + offset)), "us")).replace("T", " ")
            if name == "RIG:MOTOR" or place % 2:
                lines.append(f"{name} {stamp} {value:.6f}")
    path = tmp_path / "camonitor.txt"
    path.write_text("\n".join(lines))
    log = read_recording(path, RecordingColumns(motor="RIG:MOTOR", load="RIG:LOAD"))
    assert log.recording.time.size > made.time.size
    at = np.interp(log.recording.time - log.recording.time[5], made.time - made.time[3], made.load)
    assert np.max(np.abs(log.recording.load - at)[20:-20]) < 0.01


def test_defects_are_mended_and_counted(tmp_path, made):
    values = rows(made)
    values[:, 1] %= 2.0 * np.pi
    text = [",".join(f"{value:.9g}" for value in row) for row in values]
    text[100] = text[100].rpartition(",")[0] + ",n/a"
    text[200] = text[199]
    text[300], text[301] = text[301], text[300]
    text[400] = ",".join([*text[400].split(",")[:2], "99"])
    del text[500:560]
    text.insert(0, "-3600,0,0")
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time_s,motor_rad,load_rad", *text, ""]))
    log = read_recording(path, RecordingColumns())
    assert log.found.pop("turns of motor that were unwrapped") > 5
    assert log.found == {
        "samples without a number in some column": 1,
        "stale samples, long before all others": 1,
        "samples out of order in time": 1,
        "samples at the time of the one before": 1,
        "samples in spikes of load": 1,
        "pauses longer than five intervals": 1,
    }
    motor = np.interp(log.recording.time, made.time, made.motor)
    turns = (log.recording.motor - motor) / (2.0 * np.pi)
    assert np.max(np.abs(turns - np.round(turns[0]))) < 0.01


def test_a_log_that_ends_within_a_line_is_said_to(tmp_path, made):
    path = csv(tmp_path / "log.csv", rows(made))
    whole = path.read_bytes()
    for content, numbers in ((whole, 0), (whole[:-1], 0), (whole[: whole.rindex(b",")], 1)):
        path.write_bytes(content)
        log = read_recording(path, RecordingColumns())
        assert any("may have been cut off" in each for each in log.found) is (content is not whole)
        assert log.found.get("samples without a number in some column", 0) == numbers
        assert log.recording.time.size == made.time.size - numbers


def test_a_clean_log_is_left_as_it_is(made):
    clean = cleaned(made.time, {"motor": made.motor, "load": made.load}, {"motor": 2.0 * np.pi})
    assert not clean.found
    assert clean.channels["motor"] == pytest.approx(made.motor)


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
    assert "change of the lost motion: +0.001" in " ".join(result.output.split())
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


def test_one_column_for_both_positions_is_refused(tmp_path, made):
    path = csv(tmp_path / "log.csv", rows(made))
    with pytest.raises(InvalidInput, match="are both 'motor_rad': give two columns"):
        read_recording(path, RecordingColumns(motor="motor_rad", load="motor_rad"))


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


@pytest.mark.parametrize(("held", "times"), [(["load"], 4), (["load"], 10), (["motor", "load"], 4)])
def test_a_channel_that_is_measured_less_often_than_it_is_written_is_counted(made, held, times):
    every = np.arange(made.time.size) // times * times
    channels = {"motor": made.motor, "load": made.load, "command": made.motor[every]}
    channels |= {name: channels[name][every] for name in held}
    found = cleaned(made.time, channels, {})
    # Samples that repeat in every column are left out.
    both = len(held) == 2
    assert found.time.size == (made.time.size // times if both else made.time.size)
    # A value that equals the one before it makes a run longer; the first and the last run are not counted.
    for name in held:
        repeats = found.found[f"repeats of a {name} that is written more often than it is measured"]
        assert repeats / made.time.size == pytest.approx(1.0 - 1.0 / times, abs=0.03)
    assert len(found.found) == len(held) + both


def test_two_encoders_on_a_slow_bus_show_the_lost_motion(tmp_path):
    # The lag between held values is no lag in time: 0.0663 rad by every moment, 0.0599 by the motor's way.
    made = recording(lag=2e-3, seconds=12.0)
    every = np.arange(made.time.size) // 4 * 4
    held = replace(made, motor=made.motor[every], load=made.load[every])
    log = read_recording(csv(tmp_path / "log.csv", rows(held)), RecordingColumns())
    assert log.recording.time.size == made.time.size // 4
    found = estimate_lost_motion(log.recording)
    assert found.ok, found.reasons
    low, high = found.interval_motor
    assert low < GAP < high
    assert found.lag == pytest.approx(2e-3, abs=2e-4)


@pytest.mark.parametrize("times", [2, 4, 10])
def test_a_load_that_was_held_gives_the_gap_as_ever(made, tmp_path, times):
    every = np.arange(made.time.size) // times * times
    log = csv(tmp_path / "held.csv", zip(made.time, made.motor, made.load[every], strict=True))
    result = CliRunner().invoke(app, ["identify", str(log), "--json", "--stiff"])
    assert result.exit_code == 0, result.output
    low, high = json.loads(result.stdout)["interval_load"]
    assert low <= GAP * RATIO <= high


def test_an_encoder_of_few_counts_is_not_taken_for_one_that_is_held(made):
    load = np.round(made.load / 0.02) * 0.02
    found = cleaned(made.time, {"motor": made.motor, "load": load}, {})
    assert found.time.size == made.time.size
