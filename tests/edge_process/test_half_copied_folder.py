"""A folder of an edge that was copied in part: what is missing is said and counted, and nothing is sent wrongly."""

import json
import os
import shutil
import socket
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec
import pytest
from edge_process_parts import EDGE
from outbox_cases import window

from servotwin.edge_process.config_file import load
from servotwin.edge_process.link_process import LinkProcess
from servotwin.edge_process.monitoring import read_status, write_status
from servotwin.edge_process.startup import check, last_version, next_boot, stored_parameters
from servotwin.errors import InvalidInput
from servotwin.link.sqlite_file import connect
from servotwin.link.sqlite_outbox import SqliteOutbox

WINDOWS, OF_LOG = 24, 8


@contextmanager
def link(folder: Path, run: str = "b1-aa") -> Iterator[LinkProcess]:
    """A link process that does not run; it writes its status at the beginning and at the end."""
    ours, theirs = socket.socketpair()
    process = LinkProcess(load(folder / "edge.toml"), theirs, run)
    try:
        process._check()
        yield process
        process._check()
    finally:
        process._end_all([])
        ours.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of an edge whose newest windows are in the log of its outbox only."""
    here, copy = tmp_path / "edge", tmp_path / "copy"
    here.mkdir()
    (here / "edge.toml").write_text(
        EDGE.format(url="http://127.0.0.1:9").replace("ax-1", "axis-1")
    )  # as in its windows
    (here / "token").touch(0o600)
    (here / "token").write_text("first")
    with link(here) as process:
        for k in range(WINDOWS - OF_LOG):
            process.outbox.put(window(k))
    with link(here) as process:
        for k in range(WINDOWS - OF_LOG, WINDOWS):
            process.outbox.put(window(k))
        process._check()
        shutil.copytree(here, copy)
    return copy


@pytest.mark.parametrize(
    ("lacks", "left"),
    [("", WINDOWS), ("outbox.sqlite-wal", WINDOWS - OF_LOG), ("outbox.sqlite*", 0), ("outbox.sqlite-shm", WINDOWS)],
    ids=["nothing", "log", "outbox", "shared memory"],
)
def test_windows_of_a_file_that_was_not_copied_are_counted_once(
    folder: Path, lacks: str, left: int, capfd: pytest.CaptureFixture[str]
) -> None:
    for path in folder.glob(lacks) if lacks else ():
        path.unlink()
    for _ in range(2):
        with link(folder) as process:
            status = read_status(folder / "status.json") or {}
            assert status["windows"]["waiting"] == left
            assert status["windows"]["dropped"] == ({} if left == WINDOWS else {"outbox incomplete": WINDOWS - left})
            process.outbox.put(window(100))
            process.outbox.remove(("b0", 100))
    log = capfd.readouterr().err
    assert log.count('"event":"outbox incomplete"') == (left < WINDOWS)
    assert log.count('"event":"windows dropped"') == (left < WINDOWS)


@pytest.mark.parametrize("left", [0, 100])
def test_an_outbox_and_a_status_that_are_both_lost_are_said_once(
    folder: Path, left: int, capfd: pytest.CaptureFixture[str]
) -> None:
    for path in folder.glob("outbox.sqlite-*"):
        path.unlink()
    for name in ("outbox.sqlite", "status.json"):
        path = folder / name
        path.write_bytes(path.read_bytes()[:left])
    for run in ("b2-bb", "b3-cc"):
        assert next_boot(folder / "boots", bytes.fromhex(run[-2:])) == run, "the start of the fixture was counted"
        with link(folder, run):
            faults = (read_status(folder / "status.json") or {})["disk"]["faults"]
            assert sum(faults.values()) == (run == "b2-bb")
    log = capfd.readouterr().err
    assert log.count('"event":"outbox incomplete"') + log.count('"event":"outbox broken"') == 1


def test_a_status_of_any_bytes_tells_nothing_and_stops_nothing(folder: Path) -> None:
    (folder / "status.json").write_text("[" * 100_000)
    with link(folder) as process:
        assert len(process.outbox.pending()) == WINDOWS


@pytest.mark.parametrize("key", ["outbox", "parameters", "status", "boots"])
def test_a_pipe_in_place_of_a_file_is_refused_in_one_sentence(folder: Path, key: str) -> None:
    config = load(folder / "edge.toml")
    path = config.path(getattr(config.files, key))
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    with pytest.raises(InvalidInput, match=f"{key} = '{path.name}': is no file"):
        check(config)


def test_a_new_edge_has_lost_no_outbox(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for path in (*folder.glob("outbox.sqlite*"), folder / "status.json"):
        path.unlink()
    with link(folder):
        assert (read_status(folder / "status.json") or {})["disk"]["faults"] == {}
    assert "outbox" not in capfd.readouterr().err


@pytest.mark.parametrize("left", ["nothing", "a file", "tables"])
def test_a_first_start_that_was_killed_before_it_had_an_outbox_is_no_loss(
    folder: Path, left: str, capfd: pytest.CaptureFixture[str]
) -> None:
    for path in (*folder.glob("outbox.sqlite*"), folder / "status.json", *folder.glob("boots")):
        path.unlink()
    next_boot(folder / "boots", b"\xaa")
    if left == "a file":
        (folder / "outbox.sqlite").touch(0o600)
    if left == "tables":
        connect(folder / "outbox.sqlite").close()
    with link(folder, next_boot(folder / "boots", b"\xbb")):
        assert (read_status(folder / "status.json") or {})["disk"]["faults"] == {}
    assert "outbox" not in capfd.readouterr().err
    assert next_boot(folder / "boots", b"\xcc") == "b2-cc"


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.7, 0.95])
def test_every_window_of_an_outbox_that_was_cut_is_read_or_counted(folder: Path, share: float) -> None:
    path = folder / "outbox.sqlite"
    path.with_name("outbox.sqlite-shm").unlink()
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with link(folder) as process:
        status = read_status(folder / "status.json") or {}
        assert status["windows"]["waiting"] + sum(status["windows"]["dropped"].values()) == WINDOWS
        assert set(status["windows"]["dropped"]) <= {"outbox broken", "outbox incomplete"}
        for key in process.outbox.pending():
            assert process.outbox.get(key) == window(key[1])


@pytest.mark.parametrize("version", ["this", "before"], ids=["the file names its servo", "only its windows do"])
@pytest.mark.parametrize("renamed", [False, True], ids=["another file", "another name in edge.toml"])
def test_an_outbox_of_another_servo_is_put_aside_with_all_its_windows_and_the_edge_runs_on(
    tmp_path: Path, version: str, renamed: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    (here / "edge.toml").write_text(EDGE.format(url="http://127.0.0.1:9").replace("ax-1", "axis-1"))
    (here / "token").touch(0o600)
    (here / "token").write_text("first")
    with link(here) as process:
        for k in range(3):
            process.outbox.put(window(k))
    if version == "before":
        with closing(sqlite3.connect(here / "outbox.sqlite")) as database, database:
            database.execute("DELETE FROM notes WHERE name = 'servo'")
    (here / "edge.toml").write_text(EDGE.format(url="http://127.0.0.1:9"))
    if not renamed:
        (here / "status.json").unlink()
    own = msgspec.structs.replace(window(7), servo="ax-1")
    with link(here) as process:
        assert (process.outbox.pending(), process.outbox.dropped) == ([], {})
        process.outbox.put(own)
    with link(here) as process:
        assert process.outbox.get(("b0", 7)) == own
    [line] = [json.loads(line) for line in capfd.readouterr().err.splitlines() if "another servo" in line]
    assert (line["file"], line["of"], line["windows"]) == ("outbox.sqlite.another-1", "axis-1", 3)
    with closing(SqliteOutbox(here / line["file"], "axis-1")) as aside:
        assert [aside.get(key) for key in aside.pending()] == [window(k) for k in range(3)]


def test_a_folder_without_its_token_is_refused_in_one_sentence(folder: Path) -> None:
    (folder / "token").unlink()
    with pytest.raises(InvalidInput, match="token"):
        check(load(folder / "edge.toml"))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_a_status_that_was_cut_tells_nothing_and_stops_nothing(folder: Path, share: float) -> None:
    status = folder / "status.json"
    status.write_bytes(status.read_bytes()[: int(share * status.stat().st_size)])
    with link(folder) as process:
        assert len(process.outbox.pending()) == WINDOWS
        assert process.outbox.dropped == {}


@pytest.mark.parametrize(("servo", "version", "said"), [("axis-1", 5, 1), ("axis-1", 0, 0), ("axis-2", 5, 0)])
def test_last_parameters_that_were_not_copied_are_said(
    folder: Path, servo: str, version: int, said: int, capfd: pytest.CaptureFixture[str]
) -> None:
    write_status(folder / "status.json", {"servo": servo, "version": version})
    config = load(folder / "edge.toml")
    assert stored_parameters(folder / "parameters.json", last_version(config)) is None
    assert capfd.readouterr().err.count(f'"event":"last parameters missing","version":{version}') == said


def test_an_outbox_that_is_deleted_while_its_edge_runs_is_made_again_and_said(
    folder: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with link(folder) as process:
        for path in folder.glob("outbox.sqlite*"):
            path.unlink()
        with monkeypatch.context() as patched:
            patched.setattr("servotwin.link.moved_file._require_room", no_room)
            process._check()
            disk = (read_status(folder / "status.json") or {})["disk"]
            assert not disk["safe"]
            assert disk["trouble"].startswith("outbox.sqlite and outbox.sqlite-wal: deleted, moved or replaced")
        process._check()
        disk = (read_status(folder / "status.json") or {})["disk"]
        assert (disk["safe"], disk["trouble"], disk["faults"]["outbox moved"]) == (True, "", 1)
    with link(folder) as process:
        assert (process.outbox.waiting, process.outbox.dropped) == (WINDOWS, {})
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    assert [line["files"] for line in lines if line["event"] == "outbox moved"] == [
        ["outbox.sqlite", "outbox.sqlite-wal"]
    ]


def no_room(*_: object) -> None:
    raise OSError(28, "No space left on device")
