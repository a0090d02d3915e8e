"""`servotwin map`: resumed, shared among processes and machines, refused in one sentence; always the same bytes."""

import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from dask_cluster import Cluster
from matplotlib import image
from typer.testing import CliRunner

from servotwin.analysis.maps import store as pieces
from servotwin.analysis.maps.measures import measured
from servotwin.analysis.maps.result import StabilityMap
from servotwin.analysis.maps.store import MapStore
from servotwin.cli import app as cli
from servotwin.cli.map import figure, summary
from servotwin.cli.map.command import stability_map
from servotwin.cli.map.options import MapOptions, parsed
from servotwin.errors import InvalidInput

SMALL = ("--tolerance", "0.5:3:6", "--amplitude", "1:100:6:log", "--members", "3", "--duration", "40", "--window", "20")
REQUEST = MapOptions("paper", "0.5:3:6", "1:100:6:log", members=3, duration=40.0, window=20.0)
FILES = ("map.npz", "map.csv", "map.txt")


def run(*arguments):
    return CliRunner().invoke(cli.app, ["map", *map(str, arguments)])


SAVE, DRAW = "servotwin.cli.map.figure.save", figure.save


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    """Nine pieces instead of one, and no picture, which takes much longer than such a map."""
    monkeypatch.setattr("servotwin.analysis.maps.settings._SAMPLES_PER_CHUNK", 4 * 3 * 2100)
    monkeypatch.setattr(SAVE, lambda *_: Path())


@pytest.fixture
def drawn(monkeypatch):
    """Pictures after all."""
    monkeypatch.setattr(SAVE, DRAW)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The map in one go, in this process."""
    out = tmp_path_factory.mktemp("map") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servotwin.analysis.maps.settings._SAMPLES_PER_CHUNK", 4 * 3 * 2100)
        result = run("paper", *SMALL, "--out", out, "--workers", "1")
    assert result.exit_code == 0, result.output
    return out


def same_files(one, other):
    return [name for name in FILES if (one / name).read_bytes() != (other / name).read_bytes()] == []


@pytest.mark.slow
def test_the_files_hold_the_map(finished):
    settings = REQUEST.settings()
    whole = StabilityMap(settings, measured(settings, range(settings.count)))
    with np.load(finished / "map.npz") as file:
        assert np.array_equal(file["tolerance_per_pb"], np.linspace(0.5, 3.0, 6))
        assert np.array_equal(file["settled"], whole.grid("settled"))
        assert np.array_equal(file["effort_v"], whole.grid("effort"))
    lines = (finished / "map.csv").read_text().splitlines()
    assert lines[0].split(",")[:3] == ["tolerance_per_pb", "amplitude_per_pb", "settled"]
    assert len(lines) == 37
    assert float(lines[8].split(",")[4]) == whole.grid("error")[1, 1]
    assert len(list((finished / "chunks").iterdir())) == len(settings.chunks) == 9
    assert image.imread(finished / "map.png").shape == (1170, 1080, 4)


@pytest.mark.slow
def test_the_table_agrees_with_the_cells(finished):
    settings = REQUEST.settings()
    whole = StabilityMap(settings, measured(settings, range(settings.count)))
    value, numbers = summary.rows(whole)[2]
    settled = whole.grid("settled")[2]
    assert value == pytest.approx(1.5)
    assert numbers[:2] == pytest.approx([100.0 * np.mean(settled == 1.0), 100.0 * np.mean(settled)])
    assert numbers[2] == pytest.approx(1e3 * whole.grid("error")[2].max())
    assert f"{100.0 * np.mean(settled):.1f}" in (finished / "map.txt").read_text()


@pytest.mark.slow
def test_an_interrupted_map_goes_on_to_the_same_bytes(finished, tmp_path, monkeypatch):
    out, kept = tmp_path / "out", []

    def interrupted(self, number, measures):
        if len(kept) == 4:
            raise KeyboardInterrupt
        kept.append(number)
        keep(self, number, measures)

    keep = MapStore.save
    with monkeypatch.context() as patch:
        patch.setattr(MapStore, "save", interrupted)
        result = run("paper", *SMALL, "--out", out, "--workers", "1")
    assert result.exit_code == 130
    assert result.stderr == f"interrupted: 4 of 9 pieces are in {out}; the same command goes on from there\n"
    assert not (out / "map.npz").exists()
    computed = []
    with monkeypatch.context() as patch:
        patch.setattr(pieces, "measured", lambda *task: computed.append(task) or measured(*task))
        assert run("paper", *SMALL, "--out", out, "--workers", "1").exit_code == 0
    assert len(computed) == 5
    assert same_files(finished, out)


@pytest.mark.slow
def test_a_finished_map_is_not_computed_again(finished, monkeypatch):
    monkeypatch.setattr(pieces, "shared", lambda *_: pytest.fail("computed again"))
    before = (finished / "map.npz").read_bytes()
    assert run("paper", *SMALL, "--out", finished).exit_code == 0
    assert (finished / "map.npz").read_bytes() == before


@pytest.mark.slow
def test_a_damaged_piece_is_computed_again(finished, tmp_path):
    out = shutil.copytree(finished, tmp_path / "out")
    damaged = out / "chunks" / "000003.npz"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    (out / "chunks" / "000005.npz").write_bytes(b"")
    assert run("paper", *SMALL, "--out", out, "--workers", "1").exit_code == 0
    assert same_files(finished, out)


@pytest.mark.slow
def test_another_map_s_folder_is_refused(finished):
    before = {path: path.read_bytes() for path in finished.rglob("*.npz")}
    for change, message in (
        (("--seed", "1"), "seed = 0, not 1"),
        (("--duration", "41"), "duration_s = 40.0, not 41.0"),
        (("--enter", "0.5"), "another controller"),
    ):
        result = run("paper", *SMALL, *change, "--out", finished)
        assert result.exit_code == 2
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
    assert {path: path.read_bytes() for path in finished.rglob("*.npz")} == before
    (finished / "settings.json").rename(finished / "moved")
    result = run("paper", *SMALL, "--seed", "1", "--out", finished)
    (finished / "moved").replace(finished / "settings.json")
    assert result.exit_code == 2
    assert "other settings" in result.stderr


@pytest.mark.slow
def test_processes_give_the_same_bytes(finished, tmp_path):
    assert run("paper", *SMALL, "--out", tmp_path, "--workers", "2").exit_code == 0
    assert same_files(finished, tmp_path)


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_bytes_and_when_it_is_lost_keeps_what_is_finished(tmp_path, finished):
    pytest.importorskip("distributed")
    long = ("--tolerance", "0.5:3:30", "--amplitude", "1:100:30:log", "--members", "16", "--out", tmp_path / "out")
    with Cluster(tmp_path) as (address, scheduler):
        process = started("paper", *SMALL, "--out", tmp_path / "small", "--scheduler", address)
        _, stderr = process.communicate(timeout=120)
        assert process.returncode == 0, stderr
        assert same_files(finished, tmp_path / "small")
        process = started("paper", *long, "--scheduler", address)
        chunks = tmp_path / "out" / "chunks"
        while not list(chunks.glob("0*.npz")) and process.poll() is None:
            time.sleep(0.02)
        scheduler.kill()
        _, stderr = process.communicate(timeout=120)
    assert process.returncode == 2, stderr
    assert stderr.startswith(f"error: --scheduler {address}: the connection to it or to its workers was lost")
    assert stderr.count("\n") == 1
    assert list(chunks.glob("0*.npz"))


@pytest.mark.slow
def test_ctrl_c_ends_the_pool_with_130_and_one_line(tmp_path):
    import signal

    long = ("--tolerance", "0.5:3:30", "--amplitude", "1:100:30:log", "--members", "16", "--out", tmp_path / "out")
    process = started("paper", *long, "--workers", "2")
    chunks = tmp_path / "out" / "chunks"
    while not list(chunks.glob("0*.npz")) and process.poll() is None:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stderr.startswith("interrupted: "), stderr
    assert stderr.count("\n") == 1
    assert not list(chunks.glob(".*"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--tolerance", "0:6"), "--tolerance '0:6'"),
        (("--tolerance", "a,b"), "--tolerance 'a,b'"),
        (("--tolerance", "3:1:5"), "goes up"),
        (("--amplitude", "0:1:5:log"), "above 0"),
        (("--amplitude", "1:2:3:lin"), "is no list of values"),
        (("--amplitude", "-1,1"), "greater than 0"),
        (("--gap-deg", "nan"), "is no list of values"),
        (("--gap-deg", "-1,1"), "gap"),
        (("--gap-deg", "10"), "one value"),
        (("--tolerance", "1", "--gap-deg", "1:9:3"), "one kind"),
        (("--gap-deg", "1:9:40", "--k-dz", "1:2:41", "--estimate-deg", "1:9:42"), "panels"),
        (("--window", "200"), "window"),
        (("--members", "0"), "members"),
        (("--workers", "2", "--scheduler", "tcp://127.0.0.1:1"), "give one"),
        (("--scheduler", "nonsense"), "is no address"),
        (("--scheduler", ""), "is no address"),
        (("--out", "file/map"), "cannot be made"),
    ],
)
def test_a_user_error_is_one_sentence_and_exit_code_2(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    result = run("paper", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "servotwin-map" / "map.npz").exists()


@pytest.mark.slow
def test_a_scheduler_out_of_reach_is_one_sentence(tmp_path):
    pytest.importorskip("distributed")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
        process = started("paper", *SMALL, "--out", tmp_path, "--scheduler", address)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert stderr.startswith(f"error: --scheduler {address}: no Dask scheduler answers there within 1 s")
    assert stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axes", "size"),
    [
        ({"gap_deg": "1:9:5"}, 1),
        ({"gap_deg": "0:9:4", "estimate_deg": "5,10"}, 2),
        ({"gap_deg": "0:9:4", "k_dz": "1,2,3", "amplitude_mm": "0.5,1"}, 3),
        ({"gap_deg": "2,8", "estimate_deg": "2,8", "k_dz": "1,2", "amplitude_mm": "0.5,1"}, 4),
    ],
)
def test_as_many_axes_as_vary_are_drawn(drawn, tmp_path, axes, size):
    found = stability_map(MapOptions("table1", members=1, duration=12.0, window=10.0, **axes), tmp_path, workers=1)
    assert sum(len(values) > 1 for _, values in found.axes) == size
    assert image.imread(tmp_path / "map.png").std() > 0.05


def test_colours_show_no_difference_where_there_is_none():
    assert (figure.norm_of(np.array([2e-16, 8e-16]), 0.1).vmax) == 0.1  # all at rest
    alike = figure.norm_of(np.array([0.11405, 0.11405001]))
    assert alike(0.11405001) - alike(0.11405) < 1e-3
    assert (figure.norm_of(np.zeros(3)).vmin, figure.norm_of(np.array([1.0, 5.0])).vmax) == (0.0, 5.0)


@pytest.mark.parametrize(
    ("text", "values"),
    [("1,2.5", (1.0, 2.5)), ("7", (7.0,)), ("0:1:3", (0.0, 0.5, 1.0)), ("1:100:3:log", (1.0, 10.0, 100.0))],
)
def test_axes_are_read(text, values):
    assert parsed("--x", text) == pytest.approx(values)


def test_an_axis_is_scaled_to_si_units():
    assert parsed("--x", "1,2", 1e-3) == (1e-3, 2e-3)
    with pytest.raises(InvalidInput, match="--x '1:2'"):
        parsed("--x", "1:2")


def started(*arguments):
    command = [sys.executable, "-m", "servotwin", "map", *map(str, arguments)]
    changed = (
        "import runpy, servotwin.analysis.maps.pool as p, servotwin.analysis.maps.settings as s; "
        "import servotwin.cli.map.figure as f; f.save = lambda *_: '/'; "
        "p.CONNECT_TIMEOUT = 1.0; s._SAMPLES_PER_CHUNK = 4 * 3 * 2100; "
        "runpy.run_module('servotwin', run_name='__main__')"
    )
    command[1:3] = ["-c", changed]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
