"""A twin that has no descriptor left for a connection."""

import contextlib
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from service_system import MSGPACK, bearer, place, twin_file, window

from servotwin.messages import encode
from servotwin.twin_service import listening
from servotwin.twin_service.twin_file import read_twin

DESCRIPTORS, STRANGERS = 60, 100
FULL = "connections closed: no descriptor left"


@contextlib.contextmanager
def crowded(folder: Path, tokens: bool) -> Iterator[tuple[str, list[socket.socket]]]:
    """A twin that may have 60 descriptors, and a hundred strangers' connections to it."""
    command = ["sh", "-c", f'ulimit -n {DESCRIPTORS}; exec "$@"', "sh", sys.executable, "-m", "servotwin", "twin"]
    with (folder / "log").open("w") as log, contextlib.ExitStack() as stack:
        twin = subprocess.Popen(
            [*command, "--config", str(twin_file(folder, tokens=tokens))], stdout=subprocess.PIPE, stderr=log, text=True
        )
        assert twin.stdout is not None
        stack.callback(twin.stdout.close)
        try:
            url = twin.stdout.readline().split()[-1]
            where = "127.0.0.1", int(url.rpartition(":")[2])
            strangers = [socket.create_connection(where, source_address=("127.0.0.2", 0)) for _ in range(STRANGERS)]
            yield url, [stack.enter_context(each) for each in strangers]
        finally:
            twin.send_signal(signal.SIGTERM)
            assert twin.wait(60) == 0


def is_closed(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def is_healthy(url: str) -> bool:
    with contextlib.suppress(httpx.TransportError):
        return httpx.get(f"{url}/healthz", timeout=5.0).status_code == 200
    return False


@pytest.mark.parametrize(("granted", "is_kept"), [(1_000_000, True), (8, False)])
def test_the_last_quarter_of_the_descriptors_is_kept_from_connections(
    granted: int, is_kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listening, "most_descriptors", lambda: granted)
    config = read_twin(twin_file(tmp_path, tokens=False)).service
    with listening.listening_socket(config) as listener, socket.create_connection(listener.getsockname()) as client:
        if is_kept:
            listener.accept()[0].close()
        else:
            with pytest.raises(BlockingIOError):
                listener.accept()
        client.settimeout(5.0)
        assert client.recv(1) == b""


@pytest.mark.slow
def test_connections_without_a_descriptor_are_closed_at_once_and_the_log_says_so(tmp_path: Path) -> None:
    with crowded(tmp_path, tokens=False) as (url, strangers):
        time.sleep(3.0)
        assert sum(map(is_closed, strangers)) >= STRANGERS - DESCRIPTORS
        for each in strangers:
            each.close()
        until = time.monotonic() + 30.0
        while not is_healthy(url):
            assert time.monotonic() < until
    lines = [json.loads(line)["message"] for line in (tmp_path / "log").read_text().splitlines()]
    assert 1 <= lines.count(FULL) <= 2
    assert len(lines) < 50


@pytest.mark.slow
def test_strangers_leave_descriptors_for_edges(tmp_path: Path) -> None:
    with crowded(tmp_path, tokens=True) as (url, strangers):
        time.sleep(1.0)
        for number in range(3):
            sent = window(number)
            answer = httpx.put(f"{url}{place(sent)}", content=encode(sent), headers={**bearer(), **MSGPACK})
            assert answer.status_code == 201
        assert sum(map(is_closed, strangers)) > STRANGERS // 2
