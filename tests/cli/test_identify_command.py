"""`servotwin identify`: the gap and its trend from a log; one sentence for every invalid log."""

import json
import math

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from servotwin.cli import app as cli
from servotwin.cli import identify as identification
from servotwin.cli.identify import IdentifyOptions, identify, window_starts
from servotwin.cli.simulate import record
from servotwin.errors import InvalidInput
from servotwin.logs import formats
from servotwin.logs import log as logfile
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave
from servotwin.simulation import simulate

SCENARIO = """
servo = "paper"
duration_s = 16.0
[reference]
kind = "square"
amplitude_mm = 1.0
period_s = 10.0
[gap]
from_deg = 4.0
to_deg = 8.0
over_s = 80.0
[twin]
policy = "paper"
enabled = false
"""
WEAR = SCurve(math.radians(4.0), math.radians(8.0), 80.0)


def run(*arguments):
    return CliRunner().invoke(cli.app, ["identify", *map(str, arguments)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One run in every format, and a log of another maker: plain columns, no metadata."""
    folder = tmp_path_factory.mktemp("logs")
    (folder / "scenario.toml").write_text(SCENARIO)
    for suffix in (".csv", ".npz", ".parquet"):
        record(folder / "scenario.toml", folder / f"run{suffix}")
    found = simulate(Servo.preset("paper"), 12.0, reference=SquareWave(1e-3, 10.0), gap=WEAR)
    names = {"time_s": "time", "position_m": "position", "theta_m_rad": "theta_m", "reference_m": "reference"}
    values = np.column_stack([getattr(found, name) for name in names.values()])
    np.savetxt(folder / "plain.csv", values, fmt="%.12g", delimiter=",", header=",".join(names), comments="")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", ["run.csv", "run.npz", "run.parquet"])
def test_every_format_gives_the_gap_and_its_trend(folder, name):
    found = identify(IdentifyOptions(folder / name, gap_limit_deg=10.0))
    assert [window.start for window in found.windows] == pytest.approx([0.0, 5.0, 10.0, 15.0])
    truth = WEAR.pieces(80.0).value([estimate.time for estimate in found.estimates])
    assert all(estimate.ok for estimate in found.estimates)
    assert np.degrees([e.gap for e in found.estimates] - truth) == pytest.approx(np.zeros(4), abs=0.02)
    assert found.trend.updates == 4
    assert found.trend.gap_interval[0] < truth[-1] < found.trend.gap_interval[1]
    assert found.until_limit.interval[0] > 0.0


@pytest.mark.slow
def test_the_table_shows_gap_interval_and_trend(folder):
    result = run(folder / "run.npz", "--gap-limit-deg", "10")
    assert result.exit_code == 0
    rows = [line for line in result.output.splitlines() if line.rstrip().endswith(" ok")]
    assert len(rows) == 4
    assert rows[0].split()[:4] == ["0.00", "..", "1.00", "4.001"]
    assert "95 % interval, deg" in result.output
    assert "std" not in result.output
    for words in ("4 OK", "gap at 15.50 s: 4.3", "wear: 0.", "time until 10 deg: "):
        assert words in result.output


@pytest.mark.slow
def test_json_is_for_machines(folder):
    result = run(folder / "run.npz", "--json", "--gap-limit-deg", "90")
    found = json.loads(result.output)
    assert [window["status"] for window in found["windows"]] == ["ok"] * 4
    assert found["windows"][1]["time_s"] == pytest.approx(5.4999)
    assert found["windows"][1]["interval_deg"][0] < found["windows"][1]["gap_deg"]
    assert found["trend"]["updates"] == 4
    assert set(found["until_limit"]) == {"median_s", "interval_s", "probability"}


@pytest.mark.slow
def test_a_log_of_another_maker_needs_a_servo(folder, tmp_path):
    with pytest.raises(InvalidInput, match="give --servo"):
        identify(IdentifyOptions(folder / "plain.csv"))
    (tmp_path / "mine.toml").write_text(Servo.preset("paper").dumps())
    ours, named = (
        identify(IdentifyOptions(folder / "plain.csv", servo=s)) for s in (str(tmp_path / "mine.toml"), "paper")
    )
    assert len(ours.windows) == 3
    assert [e.gap for e in ours.estimates] == [e.gap for e in named.estimates]


@pytest.mark.slow
def test_a_screw_that_was_replaced_is_said(tmp_path):
    """A log of a maintenance engineer: the same machine with a gap of 8 deg, then with one of 1 deg."""
    servo, parts = Servo.preset("paper"), []
    for gap in (8.0, 8.0, 1.0, 1.0):
        part = simulate(servo, 10.0, reference=SquareWave(1e-3, 10.0), gap=math.radians(gap), sample_rate=2000.0)
        parts.append(np.column_stack([part.position, part.theta_m, part.reference])[:-1])
    rows = np.vstack(parts)
    table = np.column_stack([np.arange(len(rows)) / 2000.0, rows])
    names = "time_s,position_m,theta_m_rad,reference_m"
    np.savetxt(tmp_path / "log.csv", table, fmt="%.10g", delimiter=",", header=names, comments="")
    result = run(tmp_path / "log.csv", "--servo", "paper")
    lines = [line for line in result.output.splitlines() if line.startswith("at ")]
    assert [line.split(":")[0] for line in lines] == ["at 20.00 s", "at 25.00 s"]
    assert "the gap has jumped from 8 to 1 deg, as after a crash, a repair or a new screw" in " ".join(
        result.output.split()
    )
    windows = json.loads(run(tmp_path / "log.csv", "--servo", "paper", "--json").output)["windows"]
    assert [len(window["remarks"]) for window in windows] == [0, 0, 0, 0, 1, 1, 0, 0]
    assert "being an outlier" in windows[4]["remarks"][0]


@pytest.mark.parametrize(
    ("column", "other"),
    [
        ("position_m", "position_um"),
        ("theta_m_rad", "theta_m_rev"),
        ("reference_m", "reference_um"),
        ("time_s", "time_ms"),
    ],
)
def test_a_column_in_a_unit_that_is_not_read_is_named(folder, tmp_path, column, other):
    """It would be taken for a column that is missing, and the gap be read without it."""
    head, rest = (folder / "plain.csv").read_text().split("\n", 1)
    (tmp_path / "log.csv").write_text(head.replace(column, other) + "\n" + rest)
    unit = other.rpartition("_")[2]
    with pytest.raises(InvalidInput, match=f"column '{other}': the unit '{unit}' is not read; give .*{column}"):
        logfile.read_log(tmp_path / "log.csv")


def test_a_column_that_only_begins_like_a_signal_is_ignored(folder, tmp_path):
    head, rest = (folder / "plain.csv").read_text().split("\n", 1)
    (tmp_path / "log.csv").write_text(head.replace("reference_m", "reference_speed") + "\n" + rest)
    assert logfile.read_log(tmp_path / "log.csv").whole.reference is None


@pytest.mark.slow
def test_one_window_may_be_chosen(folder):
    found = identify(IdentifyOptions(folder / "run.npz", start=5.0, duration=2.0))
    (window,) = found.windows
    assert (window.start, window.duration) == pytest.approx((5.0, 2.0))
    assert found.estimates[0].ok
    assert identify(IdentifyOptions(folder / "run.npz", duration=1.0)).windows[0].start == 0.0
    with pytest.raises(InvalidInput, match="leave them out with --start"):
        identify(IdentifyOptions(folder / "run.npz", start=5.0, window=1.0))


def test_a_window_at_rest_says_so_and_there_is_no_trend(folder):
    result = run(folder / "run.npz", "--start", "14.5", "--duration", "0.4", "--method", "paper")
    assert result.exit_code == 0
    assert "0 OK" in result.output
    assert "there is no trend" in result.output
    found = json.loads(
        run(folder / "run.npz", "--start", "4.5", "--duration", "0.4", "--method", "paper", "--json").output
    )
    assert found["trend"] is None
    assert found["windows"][0]["reasons"]


@pytest.mark.slow
def test_the_method_and_the_cut_can_be_chosen(folder):
    published = identify(IdentifyOptions(folder / "run.npz", method="paper"))
    assert {estimate.method for estimate in published.estimates} == {"paper"}
    cut = identify(IdentifyOptions(folder / "run.npz", window=2.0, pre_trigger=0.3))
    assert [window.start for window in cut.windows] == pytest.approx([0.0, 4.7, 9.7])


@pytest.mark.slow
def test_a_calm_loops_log_carries_its_cut(tmp_path):
    calm = SCENARIO.replace("16.0", "12.0").replace("[twin]", "[controller]\nki_v_per_m_s = 0\n[twin]")
    (tmp_path / "calm.toml").write_text(calm)
    for name in ("calm.csv", "calm.npz", "calm.parquet"):
        record(tmp_path / "calm.toml", tmp_path / name)
        windows = identify(IdentifyOptions(tmp_path / name)).windows
        assert [window.start for window in windows] == pytest.approx([0.0, 4.7, 9.7])
        assert {window.duration for window in windows} == {2.0}


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ([0, 0, 1, 1, 1, 1, 1, 1], [2]),
        ([1, 1, 1, 1, 1, 1, 2, 2], [0]),
        ([0, 0, 1, 2, 3, 4, 5, 5, 5, 5], [2, 5]),
        ([0, 0, 0, 0], []),
        ([0, 0, 0, 1], []),
    ],
)
def test_windows_open_as_at_the_edge(reference, expected):
    assert window_starts(reference, 3, 0) == expected


def test_a_window_opens_before_the_change_as_far_as_the_log_goes():
    assert window_starts([0, 1, 1, 1, 1, 1, 2, 2, 2, 2], 4, 2) == [0, 4]


def damaged(folder, tmp_path, change):
    lines = (folder / "plain.csv").read_text().splitlines()
    path = tmp_path / "bad.csv"
    path.write_text("\n".join(change(lines)))
    return path


BAD = {
    "empty": (lambda lines: lines[:0], "line 1 must name the columns"),
    "no header": (lambda lines: lines[1:], "line 1 must name the columns"),
    "no rows": (lambda lines: lines[:1], "n >= 16 samples"),
    "blank rows": (lambda lines: [lines[0], "", ""], "n >= 16 samples"),
    "zeros": (lambda _lines: ["\0" * 100], "is not a text file"),
    "other names": (lambda lines: [lines[0].replace("theta_m_rad", "theta_motor"), *lines[1:]], "no theta_m"),
    "no position": (lambda lines: [lines[0].replace("position_m", "positon_m"), *lines[1:]], "mean 'positon_m'"),
    "no time": (lambda lines: [lines[0].replace("time_s", "t"), *lines[1:]], "column 'time_s' is missing"),
    "a word": (lambda lines: [*lines[:5], "1,two,3,4", *lines[5:]], "no table of numbers"),
    "a short row": (lambda lines: [*lines[:5], "1,2", *lines[5:]], "no table of numbers"),
    "not a number": (
        lambda lines: [*lines[:5], lines[5].replace(",", ",nan,", 1), *lines[6:]],
        "every sample must be a finite",
    ),
    "a name twice": (lambda lines: [lines[0].replace("reference_m", "theta_m_rad"), *lines[1:]], "2 columns are named"),
    "a hole": (lambda lines: lines[:50] + lines[90:], "uniformly spaced"),
    "backwards": (lambda lines: [lines[0], *lines[:0:-1]], "uniformly spaced"),
    "no steps": (lambda lines: [lines[0].replace("reference_m", "r"), *lines[1:]], "give --start and --duration"),
    "too short": (lambda lines: lines[:200], "give --start and --duration"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", BAD)
def test_a_bad_csv_is_one_sentence(folder, tmp_path, kind):
    change, message = BAD[kind]
    result = run(damaged(folder, tmp_path, change), "--servo", "paper")
    assert result.exit_code == 2, result.output
    assert message in result.stderr
    assert "bad.csv" in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("missing.csv",), "is not there"),
        (("FOLDER",), "the suffix '' is not known"),
        (("FOLDER/scenario.toml",), "allowed are .csv, .npz, .npy, .parquet"),
        (("FOLDER/run.npz", "--servo", "papre"), "papre"),
        (("FOLDER/run.npz", "--start", "-3"), "-3"),
        (("FOLDER/run.npz", "--start", "15.9", "--duration", "3"), "run.npz"),
        (("FOLDER/run.npz", "--start", "99"), "run.npz: --start 99.0 s: the log goes from 0 s to"),
        (("FOLDER/run.npz", "--duration", "0"), "the log goes from 0 s to"),
        (("FOLDER/run.npz", "--duration", "nan"), "the log goes from 0 s to"),
        (("FOLDER/run.npz", "--window", "0.01"), "needs at least 400"),
        (("FOLDER/run.npz", "--window", "nan"), "--window nan s"),
        (("FOLDER/run.npz", "--window", "90"), "give --start and --duration"),
        (("FOLDER/run.npz", "--pre-trigger", "1"), "--pre-trigger 1.0 s"),
        (("FOLDER/run.npz", "--method", "best"), "'best': must be one of whitened, paper"),
        (("FOLDER/run.npz", "--wear-deg", "3"), "belong together"),
        (("FOLDER/run.npz", "--wear-deg", "-3", "--wear-over-s", "4"), "greater than 0"),
        (("FOLDER/run.npz", "--gap-limit-deg", "nan"), "--gap-limit-deg nan"),
    ],
)
def test_a_user_error_is_one_sentence(folder, arguments, message):
    result = run(*(argument.replace("FOLDER", str(folder)) for argument in arguments))
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("suffix", [".npz", ".parquet", ".csv"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe junk", b"PK\x03\x04 not really"])
def test_junk_is_one_sentence(tmp_path, suffix, content):
    path = tmp_path / f"junk{suffix}"
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match="junk"):
        logfile.read_log(path)


def test_columns_that_hold_no_numbers(tmp_path):
    np.savez(tmp_path / "complex.npz", time_s=np.arange(20.0) + 1j, position_m=np.arange(20.0))
    with pytest.raises(InvalidInput, match="'time_s' must hold numbers"):
        logfile.read_log(tmp_path / "complex.npz")
    words = {"time_s": np.array(["a"] * 20), "position_m": np.arange(20.0)}
    np.savez(tmp_path / "words.npz", **words)
    parquet.write_table(pyarrow.table(words), tmp_path / "words.parquet")
    for name in ("words.npz", "words.parquet"):
        with pytest.raises(InvalidInput, match="'time_s' must hold numbers"):
            logfile.read_log(tmp_path / name)


def test_parquet_without_pyarrow_is_named(folder, monkeypatch):
    monkeypatch.setattr(formats.importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(InvalidInput, match="servotwin\\[parquet\\]"):
        logfile.read_log(folder / "run.parquet")


def test_measured_position_goes_before_the_true_one(folder):
    with np.load(folder / "run.npz") as file:
        columns = {name: file[name] for name in file.files}
    columns["measured_position_m"] = columns["position_m"] + 1.0
    np.savez(folder / "offset.npz", **columns)
    log = logfile.read_log(folder / "offset.npz")
    assert np.array_equal(log.whole.position, columns["measured_position_m"])


def test_a_log_without_reference_needs_start_and_duration(folder):
    log = logfile.read_log(folder / "run.npz")
    assert identification.cut(log, IdentifyOptions(folder / "run.npz", duration=1.0), Servo.preset("paper"))
    assert log.metadata["window_s"] == 1.0
