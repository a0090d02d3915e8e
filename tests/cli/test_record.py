"""`servotwin simulate`: the same numbers in every format, units in the names, metadata, nothing half written."""

import json

import numpy as np
import pytest
from pyarrow import parquet

import servotwin as st
from servotwin.cli import simulate as record
from servotwin.errors import InvalidInput

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
initial_gap_deg = 5.0
"""
COLUMNS = [
    *(
        "time_s",
        "position_m",
        "measured_position_m",
        "reference_m",
        "theta_m_rad",
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


def test_npz(written, expected):
    with np.load(written[".npz"]) as found:
        assert [name for name in found.files if name != "metadata"] == COLUMNS
        assert np.array_equal(found["position_m"], expected.position)
        assert np.array_equal(found["q3_m"], found["position_m"])
        assert np.array_equal(found["time_s"], np.arange(10001) / 5000.0)
        assert found["gap_rad"] == pytest.approx(np.radians(5.0))


def test_parquet_holds_the_same(written):
    table = parquet.read_table(written[".parquet"])
    assert table.column_names == COLUMNS
    with np.load(written[".npz"]) as found:
        for name in COLUMNS:
            assert np.array_equal(table[name].to_numpy(), found[name])


def test_csv_holds_twelve_digits(written, expected):
    found = np.genfromtxt(written[".csv"], delimiter=",", names=True, skip_header=1)
    assert list(found.dtype.names) == COLUMNS
    assert found["theta_m_rad"] == pytest.approx(expected.theta_m, rel=1e-11, abs=1e-300)


def test_metadata_tells_what_was_run(written):
    with np.load(written[".npz"]) as found:
        metadata = json.loads(str(found["metadata"]))
    assert metadata["seed"] == 7
    assert metadata["scenario"] == SCENARIO
    assert metadata["servotwin"] == st.__version__
    assert metadata["model"] == st.Servo.preset("paper").version
    assert json.loads(written[".csv"].read_text().splitlines()[0].removeprefix("# ")) == metadata
    assert parquet.read_schema(written[".parquet"]).metadata[b"scenario"].decode() == SCENARIO


def test_a_failing_writer_leaves_nothing(written, tmp_path, monkeypatch):
    def fail(_found, path):
        path.write_text("half")
        raise OSError("disk full")

    monkeypatch.setitem(record._WRITERS, ".npz", fail)
    with pytest.raises(InvalidInput, match=r"cannot be written \(disk full\)"):
        record.record(written[".npz"].parent / "scenario.toml", tmp_path / "run.npz")
    assert not list(tmp_path.iterdir())


def test_parquet_without_pyarrow_is_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(record.importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(InvalidInput, match="servotwin\\[parquet\\]"):
        record.writer(tmp_path / "run.parquet")
