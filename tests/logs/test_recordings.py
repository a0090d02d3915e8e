"""Foreign logs: every format, and what real ones have in them."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import csv, recording, rows

from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.logs import formats
from servotwin.logs.cleaning import cleaned
from servotwin.logs.columns import LogColumns, SignalTable, among
from servotwin.logs.log import describes_its_machine, read_log, write_log
from servotwin.logs.recordings import RecordingColumns, read_recording

GAP, RATIO = 0.05, 0.1


@pytest.fixture(scope="module")
def made():
    return recording(gap=GAP, ratio=RATIO, seconds=12.0, rate=200.0)


GAP, RATIO = 0.05, 0.1


def seen(path, made, columns=None):
    log = read_recording(path, columns or RecordingColumns())
    assert np.allclose(log.recording.motor, made.motor, atol=1e-8)
    assert np.allclose(log.recording.load, made.load, atol=1e-8)
    assert np.allclose(np.diff(log.recording.time), np.diff(made.time), atol=1e-6)
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
    counts = csv(tmp_path / "f.csv", values * [1.0, 4096.0, 500.0], "t [s],motor,load [mm/500]")
    parts = seen(counts, made, RecordingColumns(motor_unit="rev/4096"))
    assert (parts.recording.motor_unit, parts.recording.load_unit) == ("rev", "mm")
    for none in ("rev/0", "rev/-5", "rev/", "rev/1,5"):
        with pytest.raises(InvalidInput, match=rf"f\.csv: unit '{none}': must be divided by a number above 0"):
            read_recording(counts, RecordingColumns(motor_unit=none))
    bare = tmp_path / "e.dat"
    np.savetxt(bare, values)
    seen(bare, made, RecordingColumns(time="col1", motor="col2", load="col3"))


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".mat", ".h5", ".mcap"])
def test_the_columns_of_a_log_are_chosen_while_it_is_read(suffix, tmp_path, made, monkeypatch):
    """Formats that name their columns only at the end of the file would be read twice, which takes long."""
    calls = []
    values = {"time_s": made.time, "motor_rad": made.motor, "load_rad": made.load, "other": made.load}
    form = formats.FORMATS[suffix]

    def read(_path, requested):
        calls.append(among(requested, tuple(values)))
        return LogColumns({name: values[name] for name in calls[-1]}, tuple(values), {})

    counted = form._replace(read=read, blocks=form.blocks and (lambda *args: iter([read(*args)])), library="")
    monkeypatch.setitem(formats.FORMATS, suffix, counted)
    path = tmp_path / f"log{suffix}"
    path.touch()
    assert not (suffix not in formats.WRITTEN and describes_its_machine(path))
    seen(path, made)
    assert [sorted(each) for each in calls] == [["load_rad", "motor_rad", "time_s"]]


def test_decimal_commas_between_commas_are_refused(tmp_path, made):
    # Otherwise the digits behind a comma are read as the next column.
    with pytest.raises(InvalidInput, match=r"line 3: 6 values for 3 names.*semicolons or tabs"):
        read_recording(csv(tmp_path / "a.csv", rows(made)[1:], comma=True, comments=["# rig"]), RecordingColumns())


def test_rows_may_end_with_a_comma(tmp_path, made):
    path = csv(tmp_path / "a.csv", rows(made))
    path.write_text("\n".join(line + "," * (number > 0) for number, line in enumerate(path.read_text().splitlines())))
    seen(path, made)


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


def test_a_log_of_a_long_scenario_is_read_back(tmp_path, made):
    """Its metadata are one cell."""
    described = {"scenario": "values_mm = [" + ", ".join(["0.25", "-1.5"] * 20_000) + "]"}
    write_log(SignalTable({"time_s": made.time, "position_m": made.load}, described), tmp_path / "run.csv")
    assert read_log(tmp_path / "run.csv").metadata == described


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


def test_one_column_for_both_positions_is_refused(tmp_path, made):
    path = csv(tmp_path / "log.csv", rows(made))
    with pytest.raises(InvalidInput, match="are both 'motor_rad': give two columns"):
        read_recording(path, RecordingColumns(motor="motor_rad", load="motor_rad"))


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


def test_a_load_that_is_sampled_less_often_leaves_its_cells_empty(tmp_path):
    """Two sampling rates in one table; the motor turns by 0.6 turns between two samples of the load."""
    made = recording(gap=GAP, seconds=12.0, rate=1000.0)
    motor = 20.0 * made.motor
    step = np.max(np.abs(motor[12:] - motor[:-12]))
    turn = step / 0.6
    table = rows(replace(made, motor=np.mod(motor, turn) * (2.0 * np.pi / turn)))
    lines = [list(map(str, row)) for row in table]
    for number, line in enumerate(lines):
        if number % 12 and number > 0:
            line[2] = ""
    path = tmp_path / "log.csv"
    path.write_text("t [s],motor [rad],load [mm]\n" + "".join(",".join(line) + "\n" for line in lines))
    log = read_recording(path, RecordingColumns())
    assert log.found["rows between the samples of a slower channel"] == made.time.size - log.recording.time.size
    assert np.allclose(log.recording.load, made.load[::12])
    moved = log.recording.motor * turn / (2.0 * np.pi) - motor[::12]
    assert np.ptp(moved) < 1e-6


def test_an_encoder_of_few_counts_is_not_taken_for_one_that_is_held(made):
    load = np.round(made.load / 0.02) * 0.02
    found = cleaned(made.time, {"motor": made.motor, "load": load}, {})
    assert found.time.size == made.time.size
