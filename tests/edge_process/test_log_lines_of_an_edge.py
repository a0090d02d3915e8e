"""Lines of an edge's log, faults and dropped messages that the alarms page explains come when what they say happens."""

import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from edge_process_parts import CONFIG, EDGE, LAW, SETTINGS

from servotwin.control.gains import gains_of
from servotwin.edge.guard import Limits
from servotwin.edge.parameters import Parameters
from servotwin.edge_process.config_file import load
from servotwin.edge_process.link_child import LinkChild
from servotwin.edge_process.link_process import LinkProcess
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.edge_process.run import set_realtime_priority
from servotwin.edge_process.startup import exclusive, permitted, stored_parameters
from servotwin.link import sqlite_outbox
from servotwin.link.sqlite_outbox import LETTERS, SqliteOutbox
from servotwin.messages import Setting
from servotwin.runtime.frames import FrameSocket

Log = pytest.CaptureFixture[str]


def no(*_: object) -> None:
    raise PermissionError("not permitted")


def test_what_an_edge_cannot_do_at_its_start_is_said(
    tmp_path: Path, capfd: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", no)
    assert not set_realtime_priority(50)
    with exclusive(replace(CONFIG, folder=tmp_path / "absent")):
        pass
    file = tmp_path / "parameters.json"
    file.write_text("rubbish")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", no)
        assert stored_parameters(file) is None
    narrow = replace(SETTINGS, limits=Limits(maximum=1e-4))
    assert permitted(Parameters(3, Setting(1e-3, gains_of(LAW))), narrow) is None
    LinkChild(no, PipeOutlet(True)).check(0.0)  # type: ignore[arg-type]
    ours, theirs = socket.socketpair()
    with ours, theirs:
        number = theirs.fileno()
        command = [sys.executable, "-m", "servotwin.edge_process.link_process", str(tmp_path / "absent.toml")]
        assert subprocess.run([*command, str(number), "b1"], pass_fds=(number,), check=False).returncode == 1
    log = capfd.readouterr().err
    for event in (
        "no real-time priority",
        "not locked",
        "last parameters not readable",
        "last parameters not put aside",
        "last parameters not allowed any more",
        "link process not started",
        "link process failed",
    ):
        assert f'"event":"{event}"' in log, event


def test_a_frame_of_another_version_and_files_that_cannot_be_written_are_counted(tmp_path: Path) -> None:
    text = EDGE.format(url="http://127.0.0.1:9") + '[keep]\nmetrics = "absent/edge.prom"\n'
    (tmp_path / "edge.toml").write_text(text)
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("first")
    ours, theirs = socket.socketpair()
    pipe = FrameSocket(ours)
    process = LinkProcess(load(tmp_path / "edge.toml"), theirs, "b1-aa")
    pipe.post(b"no frame of ours")
    while pipe.backlog:
        pipe.send()
    process._receive_frames()
    (tmp_path / "status.json.new").mkdir()
    process._check()
    (tmp_path / "status.json.new").rmdir()
    process._check()
    assert set(process._status()["disk"]["faults"]) == {
        "frame not understood",
        "metrics not written",
        "status not written",
    }
    process._end_all([])
    pipe.close()


def test_letters_beyond_the_most_are_dropped_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_outbox, "_MOST_LETTERS", 3)
    box = SqliteOutbox(tmp_path / "outbox.sqlite", "axis-1")
    for number in range(5):
        box.put_letter(b"%d" % number)
    assert (len(box.letters()), box.dropped) == (3, {LETTERS: 2})
    assert [box.letter(digest).body for digest in box.letters()] == [b"2", b"3", b"4"]
    box.close()
