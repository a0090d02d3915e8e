"""The link over HTTP: delivery, refusals, and everything that may answer instead of the twin."""

import socket
import ssl
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import pytest
from faketwin import FakeTwin, Handler
from http_parcels import HELLO, LETTER, parcel, window

from servotwin.errors import InvalidInput
from servotwin.link.claim import HeldClaim
from servotwin.link.http import HttpTransport, LiveHttp
from servotwin.link.transport import Refused, Unreachable
from servotwin.messages import (
    Acknowledge,
    Refusal,
    encode,
)
from servotwin.messages.codec import deflated
from servotwin.messages.live import LiveColumns, Watched, decode_columns, encode_live


@pytest.mark.parametrize(("told", "pause"), [("2.5", 2.5), ("900", 60.0), ("-1", 0.0), ("nan", 0.0), ("soon", 0.0)])
def test_the_twin_learns_what_waits_and_tells_the_pause_before_older_windows(
    twin: FakeTwin, link: HttpTransport, told: str, pause: float
) -> None:
    twin.older_pause = told
    assert link.deliver(parcel(0)._replace(waiting=7)) == pause
    twin.older_pause = ""  # a twin of an earlier version
    assert link.deliver(parcel(1)) == 0.0
    assert link.deliver(LETTER) == 0.0
    assert twin.waiting == ["7", None]


def test_windows_and_letters_arrive(twin: FakeTwin, link: HttpTransport) -> None:
    link.deliver(parcel(0))
    link.deliver(parcel(0))
    link.deliver(LETTER)
    assert twin.windows == {("b0", 0): window(0)}
    assert twin.letters == [HELLO]


def test_one_connection_serves_many_requests(twin: FakeTwin, link: HttpTransport) -> None:
    seen = set()
    twin.fault = lambda handler, _: bool(seen.add(handler.client_address))
    for k in range(5):
        link.deliver(parcel(k))
    assert len(seen) == 1


def test_a_connection_that_the_server_closed_is_opened_again(twin: FakeTwin, link: HttpTransport) -> None:
    def close_after(handler: Handler, _: bytes) -> bool:
        handler.close_connection = True
        return False

    twin.fault = close_after
    for k in range(3):
        link.deliver(parcel(k))
    assert len(twin.windows) == 3


def test_messages_of_the_twin_are_returned_until_they_are_acknowledged(twin: FakeTwin, link: HttpTransport) -> None:
    assert link.listen(0) == []
    for k in range(3):
        twin.say(Acknowledge("axis-1", "b0", k))
    assert [len(link.listen(after)) for after in (0, 0, 2, 3)] == [3, 3, 1, 0]


@pytest.mark.parametrize(("code", "status"), [(code, 400) for code in Refusal])
def test_a_refusal_is_understood(twin: FakeTwin, link: HttpTransport, code: Refusal, status: int) -> None:
    def refuse(handler: Handler, _: bytes) -> bool:
        handler.refuse(status, code, Retry_After="7")
        return True

    twin.fault = refuse
    for ask in (lambda: link.deliver(parcel(0)), lambda: link.deliver(LETTER), lambda: link.listen(0)):
        with pytest.raises(Refused) as refused:
            ask()
        assert (refused.value.reason, refused.value.after_s) == (code, 7.0)


def test_a_wrong_token_is_a_refusal(twin: FakeTwin) -> None:
    link = HttpTransport(twin.url, "axis-1", "other", timeout_s=5.0)
    with pytest.raises(Refused, match="bad_token") as refused:
        link.deliver(parcel(0))
    assert refused.value.reason.temporary
    link.close()


@pytest.mark.parametrize(
    ("status", "body"),
    [(200, b"<html>log in here</html>"), (200, b""), (200, b"\x90"), (404, b"<html>"), (302, b""), (502, b"{}"),
     (413, b'{"code": "no such code"}'), (200, b"x" * 100_000), (500, b"x" * 100_000)],
)  # fmt: skip
def test_a_response_that_is_not_the_twins_is_unreachable(
    twin: FakeTwin, link: HttpTransport, status: int, body: bytes
) -> None:
    def answer(handler: Handler, _: bytes) -> bool:
        handler.answer(status, body)
        return True

    twin.fault = answer
    with pytest.raises(Unreachable):
        link.deliver(parcel(0))
    twin.fault = None
    link.deliver(parcel(0))
    assert len(twin.windows) == 1


def test_an_answer_that_breaks_off_is_no_delivery(twin: FakeTwin, link: HttpTransport) -> None:
    def break_off(handler: Handler, _: bytes) -> bool:
        handler.wfile.write(b"HTTP/1.1 201 Created\r\nContent-Length: 50\r\n\r\nabc")
        handler.close_connection = True
        return True

    twin.fault = break_off
    with pytest.raises(Unreachable):
        link.deliver(parcel(0))


def test_an_answer_that_never_comes_is_no_delivery() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        link = HttpTransport(f"http://127.0.0.1:{deaf.getsockname()[1]}", "axis-1", "secret", timeout_s=0.2)
        with pytest.raises(Unreachable, match="timed out"):
            link.deliver(parcel(0))
        link.close()


def test_an_address_in_capitals_is_encrypted_all_the_same() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"HTTPS://127.0.0.1:{listener.getsockname()[1]}"
        link = HttpTransport(url, "axis-1", "secret", timeout_s=1.0)
        received = []

        def hear() -> None:
            with listener.accept()[0] as line:
                received.append(line.recv(4096))

        listening = threading.Thread(target=hear)
        listening.start()
        with pytest.raises(Unreachable):
            link.deliver(parcel(0))
        listening.join(10.0)
        link.close()
    assert received[0][:1] == b"\x16"  # a TLS handshake
    assert b"secret" not in received[0]


def test_a_missing_server_is_unreachable() -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
    link = HttpTransport(url, "axis-1", "secret", timeout_s=1.0)
    with pytest.raises(Unreachable, match="refused"):
        link.deliver(parcel(0))


def test_closing_ends_a_poll_under_way(twin: FakeTwin) -> None:
    link = HttpTransport(twin.url, "axis-1", "secret", wait_s=30.0)
    woken = []

    def listen() -> None:
        try:
            link.listen(0)
        except Unreachable:
            woken.append(True)

    arrived = threading.Event()
    twin.fault = lambda *_: bool(arrived.set())
    thread = threading.Thread(target=listen)
    thread.start()
    assert arrived.wait(10.0)
    link.close()
    thread.join(10.0)
    assert woken == [True]
    link.close()


@pytest.mark.parametrize("first", [True, False])
def test_a_poll_whose_answer_was_lost_on_the_way_is_sent_again_at_once(twin: FakeTwin, first: bool) -> None:
    link, lost = HttpTransport(twin.url, "axis-1", "secret", wait_s=30.0), threading.Event()
    assert link.deliver(parcel(0)) == 0.0
    link.listen_anew()  # no poll is under way
    twin.say(Acknowledge("axis-1", "b1", 0))
    assert first or len(link.listen(0)) == 1

    def lose(handler: Any, _body: bytes) -> bool:
        if not lost.is_set():
            lost.set()
            return not handler.rfile.read(1)  # until the edge gives up
        return False

    twin.fault = lose
    with ThreadPoolExecutor(1) as pool:
        poll = pool.submit(link.listen, 0)
        assert lost.wait(10.0)
        link.listen_anew()
        assert len(poll.result(10.0)) == 1
    assert twin.requests["GET"] == 3 - first
    link.close()


def test_a_link_that_is_closed_while_it_looks_up_a_name_connects_no_more(
    twin: FakeTwin, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The socket does not exist yet when `close` looks for it."""
    asked, closed, look_up = threading.Event(), threading.Event(), socket.getaddrinfo

    def slowly(*args: Any, **options: Any) -> Any:
        asked.set()
        assert closed.wait(10.0)
        return look_up(*args, **options)

    monkeypatch.setattr(socket, "getaddrinfo", slowly)
    link, ended = HttpTransport(twin.url, "axis-1", "secret"), Queue[Exception]()
    thread = threading.Thread(target=_deliver, args=(link, ended))
    thread.start()
    assert asked.wait(10.0)
    link.close()
    closed.set()
    assert str(ended.get(timeout=10.0)) == "the link is closed"
    thread.join()
    assert twin.windows == {}


def test_closing_ends_a_connection_that_nobody_answers() -> None:
    """A firewall that swallows packets held an edge that was told to stop until it was killed, 10 s later."""
    with socket.socket() as full, ExitStack() as waiting:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        for _ in range(3):  # then its queue is full, and a further connection hears nothing
            connection = waiting.enter_context(socket.socket())
            connection.setblocking(False)
            connection.connect_ex(full.getsockname())
        link, ended = HttpTransport(f"http://127.0.0.1:{full.getsockname()[1]}", "axis-1", "x"), Queue[Exception]()
        thread = threading.Thread(target=_deliver, args=(link, ended))
        thread.start()
        with pytest.raises(Empty):
            ended.get(timeout=0.3)
        link.close()
        assert isinstance(ended.get(timeout=5.0), Unreachable)
        thread.join()


def test_the_next_address_is_tried_where_one_does_not_answer(twin: FakeTwin, monkeypatch: pytest.MonkeyPatch) -> None:
    look_up = socket.getaddrinfo

    def two(host: str, port: int, **options: Any) -> Any:
        with socket.socket() as unused:
            unused.bind(("127.0.0.1", 0))
            nobody = unused.getsockname()[1]
        return [*look_up(host, nobody, **options), *look_up(host, port, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", two)
    with closing(HttpTransport(twin.url, "axis-1", "secret")) as link:
        link.deliver(parcel(0))
    assert len(twin.windows) == 1


def test_a_twin_that_has_answered_and_is_killed_is_not_said_to_want_tls() -> None:
    ended = Queue[Exception]()
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = HttpTransport(f"http://127.0.0.1:{server.getsockname()[1]}", "axis-1", "x")
        for answer, word in ((b"HTTP/1.1 503 busy\r\nContent-Length: 0\r\n\r\n", "503"), (b"", "reset")):
            thread = threading.Thread(target=_deliver, args=(link, ended))
            thread.start()
            with server.accept()[0] as connection:
                connection.recv(100)
                connection.sendall(answer)
                if not answer:
                    connection.close()  # with bytes that were not read: a reset
                said = str(ended.get(timeout=5.0))
            thread.join()
            assert word in said
            assert "TLS" not in said
    link.close()


def _deliver(link: HttpTransport, ended: "Queue[Exception]") -> None:
    try:
        link.deliver(parcel(0))
    except Exception as error:
        ended.put(error)


def test_deflate_is_used_where_it_helps() -> None:
    body = encode(window(0))
    small, encoding = deflated(body)
    assert (encoding, zlib.decompress(small)) == ("deflate", body)
    assert deflated(b"abc") == (b"abc", "")


def test_over_tls_the_certificate_is_checked(twin: FakeTwin, certificate: Path) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    twin.server.socket = context.wrap_socket(twin.server.socket, server_side=True)
    url = twin.url.replace("http:", "https:")
    trusting = HttpTransport(url, "axis-1", "secret", str(certificate), 5.0)
    trusting.deliver(parcel(0))
    trusting.close()
    doubting = HttpTransport(url, "axis-1", "secret", None, 5.0)
    with pytest.raises(Unreachable, match="signed by none that this computer trusts"):
        doubting.deliver(parcel(1))
    assert list(twin.windows) == [("b0", 0)]
    with pytest.raises(InvalidInput, match="holds no certificates"):
        HttpTransport(url, "axis-1", "secret", str(certificate.with_name("absent.pem")))


@pytest.mark.parametrize(("begin", "end", "words"), [(1, 2, "not yet valid"), (-2, -1, "has expired")])
def test_a_certificate_that_is_out_of_date_is_named_with_the_date_of_this_computer(
    twin: FakeTwin, tmp_path: Path, begin: int, end: int, words: str
) -> None:
    made = make_certificate(tmp_path, begin, end)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(made)
    twin.server.socket = context.wrap_socket(twin.server.socket, server_side=True)
    link = HttpTransport(twin.url.replace("http:", "https:"), "axis-1", "secret", str(made), 5.0)
    today = time.strftime("%Y-%m-%d", time.gmtime())
    with pytest.raises(Unreachable, match=f"{words}.*; the clock of this computer says {today}"):
        link.deliver(parcel(0))


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificate(tmp_path_factory.mktemp("tls"), -1, 2)


def make_certificate(folder: Path, begin: int, end: int) -> Path:
    """A certificate that is valid between two days from now, with its key."""
    import datetime
    import ipaddress

    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "twin")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now + datetime.timedelta(days=begin))
        .not_valid_after(now + datetime.timedelta(days=end))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), True)
        .sign(key, hashes.SHA256())
    )
    file = folder / "twin.pem"
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    file.write_bytes(private + made.public_bytes(serialization.Encoding.PEM))
    return file


def test_a_live_view_says_what_it_is_asked_and_that_an_older_twin_has_none(twin: FakeTwin) -> None:
    link = LiveHttp(twin.url, "axis-1", "secret", None, timeout_s=5.0, wait_s=0.2)
    columns = LiveColumns("axis-1", 1, 7, 0.1, ((0.0, 1.0, 0.0, 1.0, None, None),))
    asked = []

    def answer(handler: Handler, body: bytes) -> bool:
        asked.append((handler.path, handler.headers["Servotwin-Claim"], decode_columns(body)))
        handler.answer(200, encode_live(Watched(len(asked) == 1)))
        return True

    def older(handler: Handler, _body: bytes) -> bool:
        handler.refuse(404, Refusal.NOT_UNDERSTOOD)
        return True

    def proxy(handler: Handler, _body: bytes) -> bool:
        handler.answer(200, b"<html>log in</html>")
        return True

    try:
        twin.fault = answer
        assert link.send(LiveColumns("axis-1"), HeldClaim("b1", 3))
        assert not link.send(columns, HeldClaim("b1", 3))
        path = "/v1/servos/axis-1/live"
        assert asked == [(f"{path}?wait=0.2", "3 b1", LiveColumns("axis-1")), (path, "3 b1", columns)]
        twin.fault = older
        with pytest.raises(Refused, match="without the live view") as refused:
            link.send(columns, HeldClaim("b1", 3))
        assert refused.value.reason is Refusal.UNKNOWN_SCHEMA
        twin.fault = proxy
        with pytest.raises(Unreachable, match="not the twin"):
            link.send(columns, HeldClaim("b1", 3))
    finally:
        link.close()
