"""A broker that takes no packet as large as a window: the edge says so, keeps the window, and sends what is smaller."""

import gc
import threading
import weakref
from pathlib import Path

import pytest
from mosquitto import Mosquitto, broker
from mqttparts import edge, kept, parcel, twin

from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.mqtt import MqttTransport
from servotwin.link.transport import Parcel, Unreachable
from servotwin.messages import Hello, Setting, encode
from servotwin.store.store import Store

HELLO = Parcel("axis-1", encode(Hello("axis-1", "b0", 0.0, 10.0, 0, Setting(0.0), "")))
LARGE = parcel(1)._replace(body=bytes(30_000), encoding="")


def delivered_or_why(here: MqttTransport, each: Parcel) -> str:
    try:
        here.deliver(each)
    except Unreachable as error:
        return str(error)
    return ""


def test_a_message_larger_than_what_the_broker_takes_is_not_sent_and_said(tmp_path: Path, store: Store) -> None:
    """Its limit is in its answer to the connection; what is larger would end that, again and again."""
    with (
        broker(tmp_path / "broker", settings=("max_packet_size 20000",)) as server,
        twin(Broker(server.url), store),
        edge(Broker(server.url)) as here,
    ):
        here.deliver(parcel(0))
        with pytest.raises(Unreachable, match=r"the broker takes packets of 20000 bytes at most.*has 30\d\d\d: raise"):
            here.deliver(LARGE)
        here.deliver(HELLO)
        assert kept(store) == [0]


@pytest.mark.slow
def test_a_broker_that_ends_the_connection_at_a_message_is_said_to_do_so(tmp_path: Path, store: Store) -> None:
    """As one with a limit that it does not tell."""
    with (
        broker(tmp_path / "broker", settings=("message_size_limit 20000",)) as server,
        twin(Broker(server.url), store),
        edge(Broker(server.url), timeout_s=2.0) as here,
    ):
        here.deliver(parcel(0))
        assert delivered_or_why(here, LARGE).startswith(
            "no answer of a twin within 2 s: the connection to the broker broke"
        )


def test_a_silent_twin_is_not_said_to_be_a_lost_connection(server: Mosquitto) -> None:
    with edge(Broker(server.url), timeout_s=0.5) as here:
        assert "connection" not in delivered_or_why(here, parcel(0))


@pytest.mark.slow
def test_a_message_that_is_too_large_for_the_limit_of_a_broker_that_came_back_holds_up_no_other(
    tmp_path: Path, store: Store
) -> None:
    """The client sent it again, first of all, with each connection, until the edge was started anew."""
    with (
        broker(tmp_path / "broker") as server,
        twin(Broker(server.url), store),
        edge(Broker(server.url), timeout_s=3.0) as here,
    ):
        here.deliver(parcel(0))
        server.kill()
        here._connection.publish("servotwin/axis-1/up", bytes(30_000), 60.0)
        settings = server.folder / "mosquitto.conf"
        settings.write_text(settings.read_text() + "max_packet_size 20000\n")
        server.start()
        assert [delivered_or_why(here, HELLO) for _ in range(5)][-1] == ""


def test_a_closed_connection_leaves_no_socket_to_the_garbage_collector(server: Mosquitto) -> None:
    up = threading.Event()
    events = MqttCallbacks(lambda *_: None, lambda _fresh: up.set(), lambda _why: None)
    gc.disable()
    try:
        connection = Connection(Broker(server.url), MqttSession("a", ("b",), 10), events)
        client = weakref.ref(connection._client)
        assert up.wait(10.0)
        connection.close()
        del connection
        assert client() is None
    finally:
        gc.enable()
