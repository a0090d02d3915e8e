"""Files as strangers bring them: columns within groups, quoted numbers, joined logs, exchanged columns, cut files."""

import json
import subprocess
import sys

import numpy as np
import pytest
from recordings import recording
from typer.testing import CliRunner

from servotwin.cli.app import app
from servotwin.errors import InvalidInput
from servotwin.estimation.kinematic.lost_motion import estimate_lost_motion
from servotwin.logs.recordings import CUT, RecordingColumns, read_recording


@pytest.fixture(scope="module")
def made():
    return recording(seconds=8.0, rate=200.0)


def table(path, made, *rows, header="time,motor [rad],load [mm]"):
    values = rows or (np.column_stack([made.time, made.motor, made.load]),)
    lines = [",".join(f"{value:.9g}" for value in row) for part in values for row in part]
    path.write_text("\n".join([header, *lines, ""]))
    return path


def refused(path, *options, command="identify"):
    """The one sentence of a refusal."""
    result = CliRunner().invoke(app, [command, str(path), *map(str, options)])
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    return result.stderr


def test_columns_within_a_group_are_found_by_their_last_names(tmp_path, made):
    from scipy.io import savemat

    fields = {"time": made.time, "motor": made.motor, "load": made.load}
    savemat(tmp_path / "a.mat", {"log": fields})
    assert read_recording(tmp_path / "a.mat", RecordingColumns()).columns["motor"] == "log/motor"
    assert read_recording(tmp_path / "a.mat", RecordingColumns(motor="motor")).columns["motor"] == "log/motor"
    savemat(tmp_path / "b.mat", {"one": fields, "two": fields})
    with pytest.raises(InvalidInput, match="--motor 'motor': 2 columns end so: one/motor, two/motor; give one"):
        read_recording(tmp_path / "b.mat", RecordingColumns(motor="motor"))


def test_units_of_hdf5_attributes_are_read(tmp_path, made):
    h5py = pytest.importorskip("h5py", reason="h5py is an extra: pip install 'servotwin[hdf5]'")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("time", "motor", "load"):
            file[f"run/{name}"] = getattr(made, name)
        file["run/motor"].attrs["unit"] = "deg"
        file["run/load"].attrs["units"] = np.bytes_("mm")
    found = read_recording(tmp_path / "a.h5", RecordingColumns()).recording
    assert (found.motor_unit, found.load_unit) == ("deg", "mm")


def test_an_index_of_pandas_holds_the_times(tmp_path, made):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is an extra: pip install 'servotwin[parquet]'")
    from pyarrow import parquet

    index = "__index_level_0__"
    stamps = np.datetime64("2026-03-01", "ns") + (1e9 * made.time).round().astype("timedelta64[ns]")
    for name, times in (("a.parquet", stamps), ("b.parquet", np.arange(made.time.size))):
        parquet.write_table(pyarrow.table({"motor": made.motor, "load": made.load, index: times}), tmp_path / name)
    found = read_recording(tmp_path / "a.parquet", RecordingColumns()).recording
    assert np.ptp(found.time) == pytest.approx(np.ptp(made.time), abs=1e-6)
    with pytest.raises(InvalidInput, match="the table's index counts rows: give --time COLUMN, or --rate in Hz"):
        read_recording(tmp_path / "b.parquet", RecordingColumns())


def test_quoted_decimal_commas_between_commas_are_read(tmp_path, made):
    rows = np.column_stack([made.time, made.motor, made.load]).tolist()
    lines = [",".join(f'"{value:.9f}"'.replace(".", ",") for value in row) for row in rows]
    (tmp_path / "a.csv").write_text("\n".join(['"time","motor [rad]","load [mm]"', *lines, ""]))
    assert np.allclose(read_recording(tmp_path / "a.csv", RecordingColumns()).recording.load, made.load, atol=1e-8)


def texts(path, made, separator, time, load):
    """A table whose times (s) and loads (um, far from 0) are written as the two functions do."""
    cells = [(time(t), f"{m:.6f}", load(x)) for t, m, x in zip(made.time, made.motor, micrometres(made), strict=True)]
    path.write_text("\n".join(separator.join(row) for row in [("time", "motor [rad]", "load [um]"), *cells]) + "\n")
    return path


def micrometres(made):
    return np.round(2e4 + 1e4 * made.load)


def test_quoted_decimal_commas_of_three_digits_are_no_thousands(tmp_path, made):
    path = texts(tmp_path / "a.csv", made, ",", lambda t: f'"{t:.3f}"'.replace(".", ","), lambda x: f"{x:.0f}")
    assert np.allclose(read_recording(path, RecordingColumns()).recording.time, made.time, atol=1e-3)


def test_thousands_between_tabs_are_no_decimal_commas(tmp_path, made):
    path = texts(tmp_path / "a.txt", made, "\t", lambda t: f"{t:.4f}", lambda x: f"{x:,.0f}")
    assert np.allclose(read_recording(path, RecordingColumns()).recording.load, micrometres(made))


def test_points_that_may_part_thousands_or_decimals_are_refused(tmp_path, made):
    said = refused(
        texts(
            tmp_path / "a.csv",
            made,
            ";",
            lambda t: f"{t:.4f}".replace(".", ","),
            lambda x: f"{x:,.0f}".replace(",", "."),
        )
    )
    assert "line 2: column 'load [um]', '" in said
    assert "thousands or decimals: the other numbers have decimal commas; write this column without thousands" in said


def test_a_column_with_decimal_points_beside_decimal_commas_is_read(tmp_path, made):
    path = texts(tmp_path / "a.csv", made, ";", lambda t: f"{t:.4f}".replace(".", ","), lambda x: f"{x:.1f}")
    assert np.allclose(read_recording(path, RecordingColumns()).recording.load, micrometres(made))


def test_two_logs_in_one_file_are_refused_where_the_clock_goes_back(tmp_path, made):
    one = np.column_stack([made.time, made.motor, made.load])
    path = table(tmp_path / "two.csv", made, one, one * [1.0, 1.1, 2.0])
    assert "at sample 1601 its times go back by 7.995 s: two logs in one file" in refused(path)


def test_two_logs_of_a_drive_in_one_file_are_refused_too(tmp_path, made):
    one = np.column_stack([made.time, made.motor, made.load])
    path = table(tmp_path / "two.csv", made, one, one, header="time,position [mm],force [N]")
    assert "at sample 1601 its times go back by 7.995 s" in refused(path, command="commission")


def test_a_small_step_back_of_the_clock_is_no_second_log(tmp_path, made):
    rows = np.column_stack([made.time, made.motor, made.load])
    rows[1300:, 0] -= 1.0
    assert read_recording(table(tmp_path / "back.csv", made, rows), RecordingColumns()).found


@pytest.mark.slow
def test_exchanged_columns_are_said_to_be(tmp_path, made):
    path = table(tmp_path / "log.csv", made)
    ran = CliRunner().invoke(app, ["identify", str(path), "--motor", "load", "--load", "motor", "--json"])
    found = json.loads(ran.stdout)
    assert found["status"] == "model mismatch"
    assert "--motor and --load are exchanged" in found["reasons"][0]
    ran = CliRunner().invoke(app, ["identify", str(path), "--json"])
    assert "are exchanged" not in ran.stdout


def test_a_load_that_goes_its_own_way_is_not_called_exchanged(made):
    random = np.random.default_rng(3)
    other = recording(seconds=8.0, rate=200.0)
    wandering = np.cumsum(random.normal(0.0, 0.01, made.time.size))
    found = estimate_lost_motion(type(made)(other.time, other.motor, wandering))
    assert not found.ok


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"time,motor,load\n", "holds no row of numbers below the names of its columns"),
        ("a.npz", b"\x89PNG" + bytes(100), r"is not an .npz file of numbers"),
    ],
)
def test_a_file_without_numbers_is_told_in_plain_words(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    assert refused(path).endswith(f"{message}\n")


def test_convert_finds_columns_by_their_names_and_never_writes_over_its_log(tmp_path, made):
    path = table(tmp_path / "log.csv", made)
    before = path.read_bytes()
    result = CliRunner().invoke(app, ["convert", str(path), str(tmp_path / "clean.npz")])
    assert result.exit_code == 0, result.output
    assert np.load(tmp_path / "clean.npz")["motor [rad]"].size == made.time.size
    assert "is the log itself, which would be lost" in refused(path, path, command="convert")
    assert path.read_bytes() == before


def test_a_tdms_file_that_was_cut_off_is_read_and_said_to_be(tmp_path, made):
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is an extra: pip install 'servotwin[tdms]'")
    path = tmp_path / "log.tdms"
    with nptdms.TdmsWriter(str(path)) as writer:
        for begin in range(0, 1600, 200):
            writer.write_segment(
                [
                    nptdms.ChannelObject("Rig", name, getattr(made, name)[begin : begin + 200], {"wf_increment": 5e-3})
                    for name in ("motor", "load")
                ]
            )
    path.write_bytes(path.read_bytes()[:-1600])
    ran = subprocess.run(
        [sys.executable, "-m", "servotwin", "identify", str(path)], capture_output=True, text=True, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    assert CUT in " ".join(ran.stdout.split())


def test_an_mdf_file_that_was_cut_off_leaves_no_traceback(tmp_path, made):
    asammdf = pytest.importorskip("asammdf", reason="asammdf is an extra: pip install 'servotwin[mdf]'")
    file = asammdf.MDF(version="4.10")
    file.append([asammdf.Signal(made.motor, made.time, name="motor")])
    file.save(tmp_path / "log.mf4")
    path = tmp_path / "cut.mf4"
    path.write_bytes((tmp_path / "log.mf4").read_bytes()[:2000])
    ran = subprocess.run(
        [sys.executable, "-m", "servotwin", "identify", str(path)], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert "is not an MDF file that can be read" in ran.stderr
