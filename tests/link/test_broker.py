"""A broker that cannot be reached, or does not answer, is said with its reason; no broker is needed."""

import queue
import socket
import threading
from typing import Any

import pytest
from mosquitto import free_port
from mqttparts import PATIENCE

from servotwin.link import broker
from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.twin_service.mqtt import MqttServer


def test_a_twin_that_never_reached_its_broker_says_why_once(caplog: pytest.LogCaptureFixture) -> None:
    handler: Any = None
    server = MqttServer(Broker(f"mqtt://127.0.0.1:{free_port()}"), handler, "twins")
    assert server.sentences() == ["the MQTT broker is not connected: it has not answered yet"]
    for why in ("refused", "refused", "not authorized"):
        server._on_lost(why)
    assert [record.why for record in caplog.records if record.message == "broker lost"] == ["refused", "not authorized"]
    assert server.sentences() == ["the MQTT broker is not connected: not authorized"]
    server._on_connected(False)
    assert (server.connected, server.sentences()) == (True, [])
    server._on_lost("refused")
    assert caplog.messages.count("broker lost") == 3


@pytest.mark.slow
def test_a_broker_that_ends_the_connection_unanswered_is_said_with_the_likely_reason() -> None:
    """As mosquitto does at a port with TLS, where the client speaks none."""
    said: queue.Queue[str] = queue.Queue()
    with socket.create_server(("127.0.0.1", 0)) as port:
        url = f"mqtt://127.0.0.1:{port.getsockname()[1]}"
        quiet = MqttCallbacks(lambda *_: None, lambda _: None, said.put)
        connection = Connection(Broker(url), MqttSession("edge", ("t",), 60), quiet)
        try:
            port.accept()[0].close()
            why = said.get(timeout=PATIENCE)
        finally:
            connection.close()
    assert (
        why
        == "the broker ended the connection before it answered: where its port is one with TLS, url begins with mqtts://"
    )


@pytest.mark.slow
def test_a_broker_that_accepts_the_connection_and_never_answers_is_said_to_hang(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(broker, "_KEEP_ALIVE_S", 1)
    said: queue.Queue[str] = queue.Queue()
    with socket.create_server(("127.0.0.1", 0)) as port:  # the kernel accepts, and nobody reads
        url = f"mqtt://127.0.0.1:{port.getsockname()[1]}"
        quiet = MqttCallbacks(lambda *_: None, lambda _: None, said.put)
        connection = Connection(Broker(url), MqttSession("edge", ("t",), 60), quiet)
        try:
            assert said.get(timeout=PATIENCE) == (
                "the broker has not answered for 1 s: it, or the network between, hangs"
            )
        finally:
            connection.close()


@pytest.mark.slow
def test_a_broker_that_misses_the_pings_itself_is_not_said_to_hang() -> None:
    said: queue.Queue[str] = queue.Queue()
    with socket.create_server(("127.0.0.1", 0)) as port:
        url = f"mqtt://127.0.0.1:{port.getsockname()[1]}"
        quiet = MqttCallbacks(lambda *_: None, lambda _: None, said.put)
        connection = Connection(Broker(url), MqttSession("edge", ("t",), 60), quiet)
        try:
            line, _ = port.accept()
            with line:
                line.recv(1000)
                line.sendall(bytes([0x20, 3, 0, 0, 0]))  # accepted
                line.recv(1000)
                line.sendall(bytes([0xE0, 2, 0x8D, 0]))  # disconnected: keep alive timeout
                assert said.get(timeout=PATIENCE) == "the connection to the broker broke (Keep alive timeout)"
        finally:
            connection.close()


@pytest.mark.slow
def test_a_connection_that_is_being_made_does_not_hold_up_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """As to an address that swallows packets: a stop waited for the client's own time limit, 5 s."""
    began, gone = threading.Event(), threading.Event()

    def connect(*_arguments: object, **_more: object) -> socket.socket:
        began.set()
        gone.wait(PATIENCE)
        raise OSError("no route")

    monkeypatch.setattr(socket, "create_connection", connect)
    said: queue.Queue[str] = queue.Queue()
    quiet = MqttCallbacks(lambda *_: None, lambda _: None, said.put)
    connection = Connection(Broker("mqtt://192.0.2.1"), MqttSession("edge", ("t",), 60), quiet)
    client = connection._client._thread
    assert began.wait(PATIENCE)
    connection.close()
    assert client is not None
    assert client.is_alive()  # it was not waited for
    gone.set()
    client.join(PATIENCE)
    assert said.empty()
