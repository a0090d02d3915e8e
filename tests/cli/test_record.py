"""`servotwin simulate`: the same numbers in every format, units in the names, metadata, no partly written file."""

import csv
import json
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

import servotwin as st
from servotwin.cli import simulate as record
from servotwin.cosim.scenario import preset_text
from servotwin.errors import InvalidInput
from servotwin.logs.formats import FORMATS
from servotwin.logs.log import check_output, read_log

SCENARIO = """
servo = "paper"
duration_s = 2.0
seed = 7
[reference]
kind = "step"
size_mm = 1.0
[gap]
total_deg = 5.0
[twin]
policy = "paper"
initial_gap_deg = 5.0
"""
COLUMNS = [
    *(
        "time_s",
        "position_m",
        "measured_position_m",
        "reference_m",
        "theta_m_rad",
        "measured_theta_m_rad",
        "theta_d_rad",
        "voltage_v",
        "gap_rad",
    ),
    *("tolerance_m", "q1_m", "q2_m", "q3_m"),
]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("record")
    scenario = folder / "scenario.toml"
    scenario.write_text(SCENARIO)
    return {suffix: record.record(scenario, folder / f"run{suffix}") for suffix in (".npz", ".csv", ".parquet")}


@pytest.fixture(scope="module")
def expected(written):
    return st.cosimulate(st.Scenario.load(written[".npz"].parent / "scenario.toml")).run


@pytest.mark.slow
def test_npz(written, expected):
    with np.load(written[".npz"]) as result:
        assert [name for name in result.files if name != "metadata"] == COLUMNS
        assert np.array_equal(result["position_m"], expected.position)
        assert np.array_equal(result["q3_m"], result["position_m"])
        assert np.array_equal(result["time_s"], np.arange(10001) / 5000.0)
        assert result["gap_rad"] == pytest.approx(np.radians(5.0))


def test_parquet_holds_the_same(written):
    table = parquet.read_table(written[".parquet"])
    assert table.column_names == COLUMNS
    with np.load(written[".npz"]) as result:
        for name in COLUMNS:
            assert np.array_equal(table[name].to_numpy(), result[name])


def test_csv_holds_twelve_digits(written, expected):
    columns = range(len(COLUMNS))
    result = np.genfromtxt(written[".csv"], delimiter=",", names=True, usecols=columns)
    assert list(result.dtype.names) == COLUMNS
    assert result["theta_m_rad"] == pytest.approx(expected.theta_m, rel=1e-11, abs=1e-300)


def test_metadata_describes_the_run(written):
    with np.load(written[".npz"]) as result:
        metadata = json.loads(str(result["metadata"]))
    assert metadata["seed"] == 7
    assert metadata["scenario"] == SCENARIO
    assert metadata["servotwin"] == st.__version__
    assert metadata["model"] == st.Servo.preset("paper").version
    with written[".csv"].open(newline="") as file:
        names, first, second = islice(csv.reader(file), 3)
    assert names == [*COLUMNS, "metadata"]
    assert json.loads(first[-1]) == metadata
    assert second[-1] == ""
    assert parquet.read_schema(written[".parquet"]).metadata[b"scenario"].decode() == SCENARIO


@pytest.mark.slow
def test_a_failing_writer_leaves_nothing(written, tmp_path, monkeypatch):
    def fail(_found, path):
        path.write_text("half")
        raise OSError("disk full")

    monkeypatch.setitem(FORMATS, ".npz", FORMATS[".npz"]._replace(write=fail))
    with pytest.raises(InvalidInput, match=r"cannot be written \(disk full\)"):
        record.record(written[".npz"].parent / "scenario.toml", tmp_path / "run.npz")
    assert not list(tmp_path.iterdir())


def test_parquet_without_pyarrow_is_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr("servotwin.logs.formats.importlib.util.find_spec", lambda _name: None)
    with pytest.raises(InvalidInput, match="servotwin\\[parquet\\]"):
        check_output(tmp_path / "run.parquet")


def test_pandas_reads_the_csv_as_it_is(written, expected):
    pandas = pytest.importorskip("pandas", reason="the extra pandas is not installed")
    result = pandas.read_csv(written[".csv"])
    assert list(result.columns) == [*COLUMNS, "metadata"]
    assert result["time_s"].dtype == float
    assert result["theta_m_rad"].to_numpy() == pytest.approx(expected.theta_m, rel=1e-11, abs=1e-300)
    assert json.loads(result["metadata"][0])["seed"] == 7
    table = expected.to_pandas()
    assert np.array_equal(table["theta_m_rad"], expected.theta_m)


def test_a_csv_of_the_version_before_is_read_the_same(written, tmp_path):
    """Its metadata stood in a first line that began with #."""
    with written[".csv"].open(newline="") as file:
        names, first, *rows = csv.reader(file)
    lines = [",".join(row[:-1]) for row in (names, first, *rows)]
    old = tmp_path / "old.csv"
    old.write_text("\n".join([f"# {first[-1]}", *lines]) + "\n")
    before, now = read_log(old), read_log(written[".csv"])
    assert before.metadata == now.metadata
    assert before.metadata["seed"] == 7
    assert np.array_equal(before.whole.position, now.whole.position)


def test_a_packaged_scenario_is_named_without_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, scenario = record.read_scenario(Path("fig15"))
    assert (text, scenario.duration) == (preset_text("fig15"), 200.0)
    (tmp_path / "fig15").write_text("servo = 3")
    with pytest.raises(InvalidInput, match="servo"):
        record.read_scenario(Path("fig15"))
