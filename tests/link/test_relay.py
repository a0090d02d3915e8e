"""The relays that other tests rely on: what goes in comes out, or is lost in the way that was asked for."""

import http.server
import socket
import socketserver
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from http.client import HTTPConnection, HTTPException
from typing import ClassVar

import pytest
from httprelay import Chances, Fate, HttpRelay, fate_of
from relay import Relay, State, Weather


class Echo(socketserver.BaseRequestHandler):
    """Sends everything back."""

    def handle(self) -> None:
        with suppress(OSError):
            while data := self.request.recv(65536):
                self.request.sendall(data)


@contextmanager
def serving(server: socketserver.TCPServer) -> Iterator[int]:
    with server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), name="server")
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join(10.0)


@pytest.fixture
def echo() -> Iterator[int]:
    with serving(socketserver.ThreadingTCPServer(("127.0.0.1", 0), Echo)) as port:
        yield port


def connect(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=10.0)


def all_of(connection: socket.socket, size: int) -> bytes:
    taken = bytearray()
    while len(taken) < size:
        data = connection.recv(65536)
        if not data:
            break
        taken += data
    return bytes(taken)


def test_a_relay_keeps_the_order_of_delayed_data(echo: int) -> None:
    sent = bytes(range(256)) * 2000
    with (
        Relay(echo, Weather(delay_s=(0.0, 0.05)), seed=1) as relay,
        connect(relay.port) as connection,
        ThreadPoolExecutor(1) as pool,
    ):
        answer = pool.submit(all_of, connection, len(sent))
        for k in range(0, len(sent), 50_000):
            connection.sendall(sent[k : k + 50_000])
        assert answer.result(30.0) == sent


def test_a_cut_ends_connections_and_new_ones_work(echo: int) -> None:
    with Relay(echo) as relay:
        with connect(relay.port) as connection:
            connection.sendall(b"one")
            assert all_of(connection, 3) == b"one"
            assert relay.cut() == 2
            with pytest.raises(ConnectionResetError):
                connection.recv(1)
        with connect(relay.port) as connection:
            connection.sendall(b"two")
            assert all_of(connection, 3) == b"two"
        assert relay.counts["connection"] == 2


@pytest.mark.slow
def test_stalled_data_comes_later_and_half_open_never(echo: int) -> None:
    with Relay(echo) as relay, connect(relay.port) as connection:
        relay.become(State.STALLED)
        connection.sendall(b"late")
        connection.settimeout(0.2)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        relay.become(State.FLOWING)
        connection.settimeout(10.0)
        assert all_of(connection, 4) == b"late"
        relay.become(State.HALF_OPEN)
        connection.sendall(b"gone")
        connection.settimeout(0.2)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        assert relay.counts["swallowed"] == 1


def test_down_refuses_until_it_is_up_again(echo: int) -> None:
    with Relay(echo) as relay:
        relay.become(State.DOWN)
        with connect(relay.port) as connection:
            assert is_cut(connection)
        relay.become(State.FLOWING)
        with connect(relay.port) as connection:
            connection.sendall(b"x")
            assert connection.recv(1) == b"x"
        assert relay.counts["refused"] == 1


def test_cut_by_chance_again_and_again(echo: int) -> None:
    with Relay(echo, Weather(cut_s=(0.01, 0.05)), seed=3) as relay:
        for _ in range(3):
            with connect(relay.port) as connection:
                connection.sendall(b"x")
                assert is_cut(connection)
        assert relay.counts["cut"] >= 3


def is_cut(connection: socket.socket) -> bool:
    """Read until the other end is gone."""
    try:
        while connection.recv(65536):
            pass
    except ConnectionResetError:
        return True
    return True


class Counting(http.server.BaseHTTPRequestHandler):
    """Answers with the body, and counts what it saw."""

    protocol_version = "HTTP/1.1"
    seen: ClassVar[Counter[str]] = Counter()

    def do_PUT(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.seen[self.path] += 1
        self.send_response(201)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        return


@pytest.fixture
def web() -> Iterator[int]:
    Counting.seen.clear()
    with serving(http.server.ThreadingHTTPServer(("127.0.0.1", 0), Counting)) as port:
        yield port


def put(port: int, path: str, body: bytes) -> bytes | None:
    """The answer's body; None when there was none."""
    with closing(HTTPConnection("127.0.0.1", port, timeout=10.0)) as connection:
        try:
            connection.request("PUT", path, body)
            return connection.getresponse().read()
        except (HTTPException, OSError):
            return None


def test_requests_pass_unchanged(web: int) -> None:
    body = bytes(range(256)) * 100
    with HttpRelay(web) as relay:
        assert put(relay.port, "/a", body) == body
        assert put(relay.port, "/b", b"") == b""
    assert Counting.seen == {"/a": 1, "/b": 1}


def test_each_request_meets_the_fate_that_the_seed_gives_it(web: int) -> None:
    chances = Chances(lost_before=0.2, lost_after=0.2, twice=0.2, held=0.3, hold_s=0.05)
    paths = [f"/{k}" for k in range(60)]
    fates = {path: fate_of(f"PUT {path}", 1, chances, 7) for path in paths}
    with HttpRelay(web, chances, seed=7) as relay, ThreadPoolExecutor(8) as pool:
        answers = dict(zip(paths, pool.map(lambda path: put(relay.port, path, path.encode()), paths), strict=True))
        wait_until(lambda: sum(Counting.seen.values()) == expected(fates))
        counts = relay.counts.copy()
    for path, fate in fates.items():
        assert answers[path] == (None if fate.lost_before or fate.lost_after else path.encode())
        assert Counting.seen[path] == (0 if fate.lost_before else 1 + fate.twice)
    assert min(counts[kind] for kind in ("lost before", "lost after", "twice", "held")) > 0


def expected(fates: dict[str, Fate]) -> int:
    return sum(0 if fate.lost_before else 1 + fate.twice for fate in fates.values())


def wait_until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    ticking = threading.Event()
    for _ in range(int(seconds / 0.01)):
        if condition():
            return
        ticking.wait(0.01)
    raise AssertionError("it did not happen")


def test_a_server_that_is_gone_gives_no_answer() -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    with HttpRelay(port) as relay:
        assert put(relay.port, "/a", b"x") is None
        assert relay.counts["unreachable"] == 1
