"""Link process: another edge of its servo, a corrupt outbox, a full disk, a twin that asks for windows again."""

import socket
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import pytest
from edge_process_parts import EDGE, SETTINGS, LinkEnd, cut, exchange_all
from faketwin import FakeTwin, Handler
from waiting import PATIENCE, until

from servotwin.edge.agent import Agent
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.settings import Supervision
from servotwin.edge_process import frames, link_process
from servotwin.edge_process.config_file import load
from servotwin.edge_process.link_process import LinkProcess, run_alone
from servotwin.edge_process.monitoring import read_status, write_status
from servotwin.edge_process.outlet import PipeOutlet
from servotwin.messages import Cause, ClaimStatus, Fallback, Resend, Setting
from servotwin.runtime.frames import FrameSocket
from servotwin.runtime.locks import locked
from servotwin.runtime.retry import Retry


def send(pipe: FrameSocket, sequence: int) -> None:
    pipe.post(frames.encode(frames.window_frame(cut(sequence), "b1-aa", sequence + 1)))
    while pipe.backlog:
        pipe.send()


@pytest.fixture
def twin() -> Iterator[FakeTwin]:
    with FakeTwin("ax-1", "first") as twin:
        twin.claim_status = ClaimStatus("ax-1")
        yield twin


@pytest.mark.slow
def test_an_edge_that_was_superseded_keeps_its_windows_and_tells_the_control_process(
    tmp_path: Path, twin: FakeTwin, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "edge.toml").write_text(EDGE.format(url=twin.url))
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("first")
    ours, theirs = socket.socketpair()
    pipe = FrameSocket(ours)
    running = Thread(target=LinkProcess(load(tmp_path / "edge.toml"), theirs, "b1-aa").run)
    running.start()
    try:
        send(pipe, 0)
        until(lambda: ("b1-aa", 0) in twin.windows)
        assert twin.claim_status == ClaimStatus("ax-1", "b1-aa", 1)
        twin.claim_status = ClaimStatus("ax-1", "b1-bb", 2)
        send(pipe, 1)
        found: list[frames.ToControl] = []

        def told() -> bool:
            found.extend(frames.to_control(data) for data in pipe.receive())
            return any(isinstance(frame, frames.SupersededFrame) for frame in found)

        until(told)
        until(lambda: (read_status(tmp_path / "status.json") or {}).get("conflict") is True)
    finally:
        pipe.close()
        running.join(PATIENCE)
    status = read_status(tmp_path / "status.json") or {}
    assert status["windows"] == {"waiting": 1, "stored": 2, "letters_waiting": 0, "dropped": {}}
    assert list(twin.windows) == [("b1-aa", 0)]
    assert "another edge of this servo" in capfd.readouterr().err


def test_once_a_window_comes_through_again_the_edge_asks_for_messages_at_once(tmp_path: Path, twin: FakeTwin) -> None:
    """Each way has its pauses after an outage: for some 20 s updates came too late, and were refused."""
    (tmp_path / "edge.toml").write_text(EDGE.format(url=twin.url))
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("first")
    ours, theirs = socket.socketpair()
    process, pipe, away = LinkProcess(load(tmp_path / "edge.toml"), theirs, "b1-aa"), FrameSocket(ours), Event()
    receiver = process._receiver
    assert receiver is not None
    receiver._backoff.retry = Retry(3600.0, 1.0, 3600.0)

    def fail(handler: Handler, _body: bytes) -> bool:
        handler.close_connection = away.is_set()
        return away.is_set()

    away.set()
    twin.fault = fail
    running = Thread(target=process.run)
    running.start()
    try:
        send(pipe, 0)
        until(lambda: receiver.trouble and process._session.trouble)
        twin.say(Resend("ax-1", "b1-bb"))
        away.clear()
        until(lambda: receiver.after == 1)
    finally:
        pipe.close()
        running.join(PATIENCE)


def test_the_control_process_is_told_once_by_a_frame() -> None:
    end = LinkEnd()
    outlet = PipeOutlet(has_twin=True)
    outlet.connect(end.near)
    end.send(frames.SupersededFrame())
    received = outlet.exchange()
    assert received is not None
    assert received.superseded
    exchange_all(outlet)
    end.close()


def test_an_agent_that_was_superseded_falls_back_once_and_says_why() -> None:
    fallback = FallbackSet(Setting(0.0))
    settings = replace(
        SETTINGS, boot="b1", parameters=Parameters(3, Setting(1e-4)), supervision=Supervision(fallback=fallback)
    )
    agent = Agent(settings)
    agent.absorb_block(*(array("d", [0.0]) * 10 for _ in range(4)))
    [sent] = agent.superseded()
    assert isinstance(sent.message, Fallback)
    assert (sent.message.cause, sent.message.replaced) == (Cause.CONFLICT, 3)
    assert agent.parameters.fallback
    assert agent.superseded() == []


@pytest.mark.slow
def test_a_twin_gets_windows_again_a_full_disk_is_said_and_a_corrupt_outbox_is_logged(
    tmp_path: Path, twin: FakeTwin, capfd: pytest.CaptureFixture[str]
) -> None:
    """A link process with a corrupt outbox; then a twin that lost its windows; then a disk without room."""
    (tmp_path / "edge.toml").write_text(EDGE.format(url=twin.url))
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("first")
    (tmp_path / "outbox.sqlite").write_bytes(b"rubbish" * 1000)
    write_status(tmp_path / "status.json", {"windows": {"waiting": 80}, "room": " " * 2000})
    ours, theirs = socket.socketpair()
    pipe = FrameSocket(ours)
    process = LinkProcess(load(tmp_path / "edge.toml"), theirs, "b1-aa")
    running = Thread(target=process.run)
    running.start()
    try:
        for k in range(3):
            send(pipe, k)
        # The twin has a window before the edge has its acknowledgement, and a status may be of before all of them.
        until(lambda: len(twin.windows) == 3 and not process.outbox.pending())
        acknowledged = {"waiting": 0, "stored": 3, "letters_waiting": 0, "dropped": {"outbox broken": 80}}
        until(lambda: (read_status(tmp_path / "status.json") or {}).get("windows") == acknowledged)
        twin.windows.clear()
        twin.say(Resend("ax-1", "b1-aa", 1, reason="restored"))
        until(lambda: sorted(twin.windows) == [("b1-aa", 1), ("b1-aa", 2)])
        (tmp_path / "status.json.new").mkdir()
        until(lambda: (read_status(tmp_path / "status.json") or {}).get("disk", {}).get("safe") is False)
        (tmp_path / "status.json.new").rmdir()
        until(lambda: (read_status(tmp_path / "status.json") or {}).get("disk", {}).get("safe") is True)
    finally:
        pipe.close()
        running.join(PATIENCE)
    status = read_status(tmp_path / "status.json") or {}
    assert status["windows"]["dropped"] == {"outbox broken": 80}
    log = capfd.readouterr().err
    assert '"event":"outbox broken","file":"outbox.sqlite.broken-1","rescued":0,"lost":80' in log
    assert '"event":"windows asked for again","number":2,"why":"restored"' in log


def test_an_outbox_is_read_only_after_the_link_process_before_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its control process was killed alone: what it stores last must be in the next one's index, or it waits on."""
    (tmp_path / "edge.toml").write_text(EDGE.format(url="http://127.0.0.1:9"))
    ended, began_after_it = Event(), list[bool]()

    class Opened:
        def __init__(self, *_: object) -> None:
            began_after_it.append(ended.is_set())

        def run(self) -> None:
            """End at once."""

    monkeypatch.setattr(link_process, "LinkProcess", Opened)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        running = Thread(target=run_alone, args=(load(tmp_path / "edge.toml"), theirs, "b2-bb"))
        with locked(tmp_path / "outbox.sqlite-link-lock"):
            running.start()
            running.join(0.2)
            ended.set()
        running.join(PATIENCE)
    assert began_after_it == [True]
    monkeypatch.setattr(link_process, "locked", lambda *_, **__: (_ for _ in ()).throw(OSError("no locks here")))
    run_alone(load(tmp_path / "edge.toml"), theirs, "b2-bb")
    assert began_after_it == [True, True]


def test_windows_that_an_earlier_link_process_has_dropped_are_not_logged_again(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "edge.toml").write_text(EDGE.format(url="http://127.0.0.1:9"))
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("first")
    for _ in range(2):
        ours, theirs = socket.socketpair()
        process = LinkProcess(load(tmp_path / "edge.toml"), theirs, "b1-aa")
        if not process.outbox.dropped:
            process.outbox.count_dropped("bad_checksum")
        process._check()
        process._end_all([])
        ours.close()
    assert capfd.readouterr().err.count('"event":"windows dropped","bad_checksum":1') == 1


def test_an_edge_says_which_window_is_longer_than_its_twin_takes(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "edge.toml").write_text(EDGE.format(url="http://127.0.0.1:9") + "[window]\nlongest_window_s = 3.0\n")
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("first")
    ours, theirs = socket.socketpair()
    process = LinkProcess(load(tmp_path / "edge.toml"), theirs, "b1-aa")
    assert process._transport is not None
    for samples in (0, 300, 299, 99):
        process._transport.twin = ClaimStatus("ax-1", samples_per_window=samples, bytes_per_day=5)
        process._check()
    assert (read_status(tmp_path / "status.json") or {})["limits"] == {"samples_per_window": 99, "bytes_per_day": 5}
    process._end_all([])
    ours.close()
    told = [line for line in capfd.readouterr().err.splitlines() if '"where":"windows"' in line]
    assert "longest_window_s = 3.0 s has 300 samples; the twin takes at most 299" in told[0]
    assert '"why":"window_s = 1.0 s has 100 samples; the twin takes at most 99' in told[1]
    assert len(told) == 2
