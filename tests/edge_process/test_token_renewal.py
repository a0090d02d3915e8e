"""A token that is replaced while the edge runs: the link process ends, so that the next one reads it."""

import socket
import sys
from io import StringIO
from pathlib import Path
from threading import Thread

import pytest
from edge_process_parts import EDGE, cut
from faketwin import FakeTwin
from selfsigned import self_made
from waiting import until

from servotwin.edge_process import frames
from servotwin.edge_process.config_file import load
from servotwin.edge_process.link_process import LinkProcess
from servotwin.edge_process.monitoring import read_status
from servotwin.messages import ClaimStatus, Refusal
from servotwin.runtime.frames import FrameSocket

PATIENCE = 60.0


def write_token(folder: Path, token: str) -> None:
    (folder / "new").write_text(token)
    (folder / "new").chmod(0o600)
    (folder / "new").replace(folder / "token")


@pytest.fixture
def linked(tmp_path: Path):
    """A link process in a thread, its twin not there."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    (tmp_path / "edge.toml").write_text(EDGE.format(url=f"http://127.0.0.1:{port}"))
    write_token(tmp_path, "first")
    ours, theirs = socket.socketpair()
    running = Thread(target=LinkProcess(load(tmp_path / "edge.toml"), theirs, "b1-00").run)
    running.start()
    yield tmp_path, running
    ours.close()
    running.join(PATIENCE)
    assert not running.is_alive()


@pytest.mark.slow
def test_the_link_process_ends_when_its_token_is_replaced(linked, capfd):
    folder, running = linked
    running.join(1.5)
    assert running.is_alive(), "the same token, however long the twin is away"
    write_token(folder, "second")
    running.join(PATIENCE)
    assert not running.is_alive()
    log = capfd.readouterr().err
    assert '"event":"token replaced"' in log
    assert "first" not in log
    assert "second" not in log


@pytest.mark.slow
def test_the_link_process_goes_on_while_its_token_is_missing(linked):
    folder, running = linked
    (folder / "token").unlink()
    running.join(2.5)
    assert running.is_alive()


@pytest.mark.slow
def test_the_link_process_ends_when_the_certificates_that_it_trusts_are_replaced(tmp_path, capfd):
    """As where a twin's self-made certificate was renewed: the machine need not be stopped for it."""
    (tmp_path / "new").mkdir()
    made, renewed = self_made(tmp_path)[0], self_made(tmp_path / "new")[0]
    (tmp_path / "edge.toml").write_text(
        EDGE.format(url="https://127.0.0.1:9").replace("[twin]", '[twin]\nca_file = "made.crt"')
    )
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("first")
    link = Link(tmp_path, "b1-00")
    try:
        for content in (None, b"half of a file"):
            if content is not None:
                made.write_bytes(content)
            link.running.join(1.5)
            assert link.running.is_alive()
        renewed.replace(made)
        link.running.join(PATIENCE)
        assert not link.running.is_alive()
    finally:
        link.end()
    assert '"event":"certificates replaced"' in capfd.readouterr().err


class Link:
    """A link process in a thread, as the control process of a run starts it."""

    def __init__(self, folder: Path, run: str) -> None:
        self.pipe, theirs = socket.socketpair()
        self.running = Thread(target=LinkProcess(load(folder / "edge.toml"), theirs, run).run)
        self.running.start()

    def send(self, sequence: int) -> None:
        near = FrameSocket(self.pipe)
        near.post(frames.encode(frames.window_frame(cut(sequence), "b1-00", sequence + 1)))
        while near.backlog:
            near.send()

    def end(self) -> None:
        self.pipe.close()
        self.running.join(PATIENCE)
        assert not self.running.is_alive()


@pytest.mark.slow
def test_trouble_that_a_new_token_ends_is_over_in_the_log_once_the_twin_has_acknowledged(tmp_path, monkeypatch):
    log = StringIO()  # capfd loses what other threads write while it is read
    monkeypatch.setattr(sys, "stderr", log)

    def logged(event: str, where: str) -> int:
        return sum(f'"event":"{event}","where":"{where}"' in line for line in log.getvalue().splitlines())

    both = "to the twin", "from the twin"
    write_token(tmp_path, "first")
    with FakeTwin("ax-1", "second") as twin:
        twin.claim_status = ClaimStatus("ax-1")
        (tmp_path / "edge.toml").write_text(EDGE.format(url=twin.url))
        link = Link(tmp_path, "b1-00")
        link.send(0)
        until(lambda: all(logged("trouble", way) == 1 for way in both))
        twin.fault = lambda handler, _: handler.refuse(503, Refusal.UNAVAILABLE) or True
        write_token(tmp_path, "second")
        link.running.join(PATIENCE)
        link.end()
        link = Link(tmp_path, "b1-00")
        until(lambda: all(logged("trouble", way) >= 2 for way in both))
        assert log.getvalue().count("token replaced") == 1
        assert not any(logged("trouble over", way) for way in both), "nothing was acknowledged yet"
        twin.fault = None
        until(lambda: ("b1-00", 0) in twin.windows)
        until(lambda: all(logged("trouble over", way) == 1 for way in both))
        link.end()
        link = Link(tmp_path, "b1-00")  # restarted again, in a run without trouble since
        link.send(1)
        until(lambda: ("b1-00", 1) in twin.windows)
        until(lambda: (read_status(tmp_path / "status.json") or {})["up"].get("windows") == 1)
        link.end()
        assert all(logged("trouble over", way) == 1 for way in both)
        twin.token = "third"
        link = Link(tmp_path, "b1-00")
        link.send(2)
        until(lambda: "bad_token" in (read_status(tmp_path / "status.json") or {})["up"]["trouble"])
        link.end()
        twin.token = "second"
        over = [logged("trouble over", way) for way in both]
        link = Link(tmp_path, "b2-00")  # another start of the edge, whose log has no trouble
        until(lambda: ("b1-00", 2) in twin.windows)
        link.end()
        assert [logged("trouble over", way) for way in both] == over
