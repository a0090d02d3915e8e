"""Faults of TLS: each client says in one sentence what is wrong and which key mends it, and sends no secret."""

import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from queue import Queue
from threading import Thread

import pytest
from mosquitto import Mosquitto, Tls
from selfsigned import self_made, without_intermediate
from wiretap import Wiretap, wiretap

from servotwin.cli.audit import Source, audit
from servotwin.errors import InvalidInput
from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.http import HttpTransport
from servotwin.link.transport import Unreachable
from servotwin.twin_service import webhook

SECRET = "the-secret"
NO_TLS = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n"
Served = tuple[Wiretap, Path | None]
"""Server with a fault, and the certificates that its client trusts; None: the system's."""
Asked = Callable[[str, Path | None, Path], str]
"""Scheme with ://host:port, certificates that are trusted, folder; the sentence."""


@contextmanager
def other_host(folder: Path) -> Iterator[Served]:
    made = self_made(folder, "twin.example")
    with wiretap(made) as server:
        yield server, made[0]


@contextmanager
def expired(folder: Path) -> Iterator[Served]:
    made = self_made(folder, days=(-3.0, -1.0))
    with wiretap(made) as server:
        yield server, made[0]


@contextmanager
def not_yet_valid(folder: Path) -> Iterator[Served]:
    made = self_made(folder, days=(1.0, 3.0))
    with wiretap(made) as server:
        yield server, made[0]


@contextmanager
def unknown_issuer(folder: Path) -> Iterator[Served]:
    with wiretap(self_made(folder)) as server:
        yield server, None


@contextmanager
def no_intermediate(folder: Path) -> Iterator[Served]:
    root, leaf = without_intermediate(folder)
    with wiretap(leaf) as server:
        yield server, root


@contextmanager
def old_version(folder: Path) -> Iterator[Served]:
    made = self_made(folder)
    with wiretap(made, ssl.TLSVersion.TLSv1_1) as server:
        yield server, made[0]


@contextmanager
def no_tls(folder: Path) -> Iterator[Served]:
    with wiretap(answer=NO_TLS) as server:
        yield server, self_made(folder)[0]


def of_edge(address: str, ca: Path | None, _folder: Path) -> str:
    link = HttpTransport("https" + address, "axis-1", SECRET, None if ca is None else str(ca), 5.0, 0.0)
    with pytest.raises(Unreachable) as raised:
        link.listen(0)
    link.close()
    return str(raised.value)


def of_broker(address: str, ca: Path | None, _folder: Path) -> str:
    lost: Queue[str] = Queue()
    broker = Broker("mqtts" + address, "user", SECRET, None if ca is None else str(ca))
    events = MqttCallbacks(lambda *_: None, lambda _forgotten: None, lost.put)
    connection = Connection(broker, MqttSession("edge", (), 0), events)
    try:
        return lost.get(timeout=30.0)
    finally:
        connection.close()


def of_webhook(address: str, ca: Path | None, _folder: Path) -> str:
    config = webhook.WebhookConfig("https" + address + "/hook", SECRET, None if ca is None else str(ca))
    with pytest.raises(webhook.WebhookAway) as raised:
        webhook.send_post(config, webhook.alarm_post("ax-1", "alarm", "a sentence", 0.0))
    return str(raised.value)


def of_audit(address: str, ca: Path | None, folder: Path) -> str:
    token = folder / "token"
    token.touch(0o600)
    token.write_text(SECRET)
    with pytest.raises(InvalidInput) as raised:
        audit("ax-1", Source(Path("twin.toml"), "https" + address, token, ca), 20, False, False)
    return str(raised.value)


FAULTS = [
    (other_host, "its certificate is for another host than that of url (IP address mismatch, certificate is not valid"),
    (expired, "a certificate has expired; the clock of this computer says 20"),
    (not_yet_valid, "a certificate is not yet valid; the clock of this computer says 20"),
    (unknown_issuer, "its certificate is signed by none that this computer trusts (self-signed certificate): give"),
    (no_intermediate, "does not lead to one of {key} {ca} (unable to get local issuer certificate)"),
    (old_version, "no version of TLS that both allow: here 1.2 and later"),
    (no_tls, "does not answer with TLS"),
]


ASKED = [
    *((of_edge, *each) for each in FAULTS),
    *(
        (ask, *each)
        for ask in (of_broker, of_webhook, of_audit)
        for each in FAULTS
        if each[0] in (expired, unknown_issuer, no_intermediate)
    ),
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*ssl.SSLSocket:pytest.PytestUnraisableExceptionWarning")  # paho closes it so
@pytest.mark.parametrize(
    ("ask", "fault", "words"), ASKED, ids=[f"{ask.__name__}-{fault.__name__}" for ask, fault, _ in ASKED]
)
def test_a_fault_of_tls_is_one_sentence_and_no_secret_goes_over_the_wire(
    ask: Asked, fault: Callable[[Path], AbstractContextManager[Served]], words: str, tmp_path: Path
) -> None:
    key = "--ca" if ask is of_audit else "ca_file"
    with fault(tmp_path) as (server, ca):
        said = ask(f"://127.0.0.1:{server.port}", ca, tmp_path)
    assert words.format(key=key, ca=ca) in said
    assert (key in said) == (fault in (unknown_issuer, no_intermediate))
    assert not any(word in said for word in ("_ssl.c", "Error", "\n"))
    assert SECRET.encode() not in server.received


@pytest.mark.parametrize("ask", [of_edge, of_webhook])
def test_a_handshake_that_does_not_end_is_named(ask: Asked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "_TIMEOUT_S", 0.3)
    monkeypatch.setattr(HttpTransport, "__init__", _quick(HttpTransport.__init__))
    with wiretap(mute=True) as server:
        said = ask(f"://127.0.0.1:{server.port}", None, tmp_path)
    assert "does not end the TLS handshake" in said


def _quick(init: Callable[..., None]) -> Callable[..., None]:
    return lambda self, url, servo, token, ca, _timeout, wait: init(self, url, servo, token, ca, 0.3, wait)


def test_a_server_that_wants_a_certificate_of_the_edge_is_named(tmp_path: Path) -> None:
    """Its alert or the end of the connection comes first, by chance."""
    made = self_made(tmp_path)
    with wiretap(made, mutual=True) as server:
        said = of_edge(f"://127.0.0.1:{server.port}", made[0], tmp_path)
    ends = "TLS failed (tlsv13 alert certificate required)", "the server ended the encrypted connection"
    assert said in (*ends, "Connection reset by peer", "Broken pipe")


def test_a_url_without_tls_at_a_port_with_it_is_said_with_the_likely_reason(tmp_path: Path) -> None:
    with wiretap(self_made(tmp_path)) as server:
        link = HttpTransport(f"http://127.0.0.1:{server.port}", "axis-1", SECRET, None, 5.0, 0.0)
        with pytest.raises(Unreachable, match="where its port is one with TLS, url begins with https://"):
            link.listen(0)
        with pytest.raises(InvalidInput, match="where its port is one with TLS, url begins with https://"):
            audit("ax-1", Source(Path("twin.toml"), f"http://127.0.0.1:{server.port}"), 20, False, False)
    link.close()


def test_closing_a_link_ends_its_handshake(tmp_path: Path) -> None:
    """A server that never answers held the link process until its time limit, 35 s for a poll."""
    with wiretap(mute=True) as server:
        link = HttpTransport(f"https://127.0.0.1:{server.port}", "axis-1", SECRET, None, 30.0, 0.0)
        ended: Queue[Exception] = Queue()
        thread = Thread(target=_listen, args=(link, ended))
        thread.start()
        assert server.connected.wait(10.0)
        time.sleep(0.2)  # it is in the handshake now, or soon
        link.close()
        assert isinstance(ended.get(timeout=10.0), Unreachable)
        thread.join()


def _listen(link: HttpTransport, ended: "Queue[Exception]") -> None:
    try:
        link.listen(0)
    except Exception as error:
        ended.put(error)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*ssl.SSLSocket:pytest.PytestUnraisableExceptionWarning")  # paho closes it so
def test_a_broker_with_a_renewed_certificate_is_reached_once_the_trusted_file_is_renewed(tmp_path: Path) -> None:
    """A twin had to be restarted for it."""
    (tmp_path / "new").mkdir()
    trusted, renewed = self_made(tmp_path)[0], self_made(tmp_path / "new")
    server = Mosquitto(tmp_path, tls=Tls(*renewed))
    told: Queue[str] = Queue()
    events = MqttCallbacks(lambda *_: None, lambda _forgotten: told.put("ready"), told.put)
    server.start()
    connection = Connection(Broker(server.url, ca_file=str(trusted)), MqttSession("twin", ("t",), 0), events)
    try:
        assert "does not lead to one of ca_file" in told.get(timeout=30.0)
        trusted.write_bytes(b"half of a file")
        assert "does not lead to one of ca_file" in told.get(timeout=30.0)
        trusted.write_bytes(renewed[0].read_bytes())
        while (word := told.get(timeout=30.0)) != "ready":
            assert "does not lead to one of ca_file" in word
    finally:
        connection.close()
        server.kill()
