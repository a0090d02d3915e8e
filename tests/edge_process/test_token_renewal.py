"""A token that is replaced while the edge runs: the link process ends, so that the next one reads it."""

import socket
from pathlib import Path
from threading import Thread

import pytest

from servotwin.edge_process.config_file import load
from servotwin.edge_process.link_process import LinkProcess

EDGE = """
servo = "ax-1"
role = "supervise"
sample_rate_hz = 1000.0
[drive]
kind = "simulated"
address = "unix:nothing.sock"
[retry]
first_s = 0.05
longest_s = 0.1
[twin]
url = "http://127.0.0.1:{port}"
token_file = "token"
"""
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
    (tmp_path / "edge.toml").write_text(EDGE.format(port=port))
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
