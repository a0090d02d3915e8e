"""Connection to an MQTT 5 broker, which reconnects by itself; the edge and the twin both use it.

Needs paho-mqtt (extra `mqtt`), which is imported when a connection is made.
"""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from servotwin.errors import InvalidInput
from servotwin.link.transport import Unreachable
from servotwin.link.url import read_again, tls_context
from servotwin.runtime.extras import missing_extra

if TYPE_CHECKING:
    import ssl

    from paho.mqtt.client import Client, MQTTMessage

_SCHEMES = {"mqtt": 1883, "mqtts": 8883}
_KEEP_ALIVE_S = 20
"""Longest silence before a ping, and longest wait for its answer or for that to CONNECT; the broker itself counts a
connection as broken that is silent for half as long again."""
_MOST_QUEUED = 10_000
"""Largest number of messages that wait for the broker."""
_LINGER_S = 1.0
"""Longest time that a DISCONNECT may take when the connection is closed."""


@dataclass(frozen=True, slots=True)
class Broker:
    """Address of a broker, and the credentials there.

    Parameters
    ----------
    url : str
        mqtt(s)://host[:port].
    user : str, optional
    password : str, optional
        Not shown in `repr`.
    ca_file : str, optional
        File of the certificates that the broker's is checked against; None: the system's.
    """

    url: str
    user: str | None = None
    password: str | None = field(default=None, repr=False)
    ca_file: str | None = None

    def __post_init__(self) -> None:
        if not is_mqtt(self.url):
            raise InvalidInput(f"url = {self.url!r} is not allowed; give mqtt(s)://host[:port]")
        if self.password is not None and self.user is None:
            raise InvalidInput("a password for the broker is given, but no user")

    @property
    def tls(self) -> bool:
        """The connection is encrypted."""
        return urlsplit(self.url).scheme == "mqtts"

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        parts = urlsplit(self.url)
        return parts.hostname or "", parts.port or _SCHEMES[parts.scheme]


def is_mqtt(url: str) -> bool:
    """True where a URL is a broker's: mqtt(s)://host[:port]."""
    try:
        parts = urlsplit(url)
        plain = parts.path in ("", "/") and not (parts.query or parts.fragment) and parts.username is None
        return parts.scheme in _SCHEMES and bool(parts.hostname) and plain and parts.port != 0
    except ValueError:
        return False


def check_broker(broker: Broker) -> None:
    """Check that connections to a broker can be made, before one is.

    Raises
    ------
    InvalidInput
        paho-mqtt is missing, or the file of certificates cannot be used.
    """
    _import_paho()
    if broker.tls:
        tls_context(broker.ca_file)


class MqttSession(NamedTuple):
    """Session at a broker: client, topics, expiry.

    Attributes
    ----------
    client_id : str
        Identifies the session at the broker.
    topics : tuple of str
        Subscriptions, with delivery at least once.
    session_s : int
        Time for which the broker keeps the session, and the messages for it, after its connection broke.
    receive : int
        Largest number of messages to this end that are not acknowledged yet.
    will : str
        Topic of the message that the broker publishes when the connection breaks; empty: none.
    """

    client_id: str
    topics: tuple[str, ...]
    session_s: int
    receive: int = 100
    will: str = ""


class MqttCallbacks(NamedTuple):
    """Callbacks of a connection, called on its own thread.

    Attributes
    ----------
    message : callable
        Called with topic, payload, and a function that acknowledges the message to the broker (from any thread; it has
        no effect on a later connection).
    ready : callable
        Called after the subscription; the argument is True where the broker has forgotten the session.
    lost : callable
        Called with the reason when the connection broke or was refused.
    not_delivered : callable
        Called with the number of a message that the broker delivers to nobody, and why: its topic has no subscriber
        ("": the broker accepted it), or the broker refuses it.
    """

    message: Callable[[str, bytes, Callable[[], None]], None]
    ready: Callable[[bool], None]
    lost: Callable[[str], None]
    not_delivered: Callable[[int, str], None] = lambda _number, _why: None


class Connection:
    """Connection that is restored after every loss until it is closed.

    Parameters
    ----------
    broker : Broker
    session : MqttSession
    events : MqttCallbacks
    """

    def __init__(self, broker: Broker, session: MqttSession, events: MqttCallbacks) -> None:
        self._session, self._events = session, events
        self._number, self._fresh, self._up, self._answered, self._closing = 0, True, False, False, False
        self._largest = 0
        self._broker, self._context = broker, tls_context(broker.ca_file) if broker.tls else None
        self._hint = "" if broker.tls else ": where its port is one with TLS, url begins with mqtts://"
        self._client = _client(broker, session, self._context)
        self._client.on_socket_open = _no_delay
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_subscribe, self._client.on_message = self._subscribed, self._message
        self._client.on_publish = self._published
        self._client.on_connect_fail = self._failed
        self._client.connect_async(
            *broker.address, keepalive=_KEEP_ALIVE_S, clean_start=False, properties=_connect_properties(session)
        )
        self._client.loop_start()

    def publish(self, topic: str, payload: bytes, expiry_s: float) -> int | None:
        """Send at least once, within `expiry_s`; return the message's number, None where too many wait already.

        Raises
        ------
        Unreachable
            It is larger than what the broker takes, which would end the connection.
        """
        size, most = len(payload) + len(topic.encode()) + _OVERHEAD, self._largest
        if 0 < most < size:
            raise Unreachable(
                f"the broker takes packets of {most} bytes at most, and this message has {size}: raise its limit"
            )
        properties = _properties("PUBLISH", MessageExpiryInterval=max(1, round(expiry_s)))
        info = self._client.publish(topic, payload, qos=1, properties=properties)
        return info.mid if info.rc in (0, _NO_CONNECTION) else None

    def renew(self) -> None:
        """Cut the connection; it is restored, and both ends send again what the other has not acknowledged."""
        _shut(self._client.socket())

    def close(self) -> None:
        """Disconnect; a broker that does not respond delays this by `_LINGER_S` at most."""
        self._closing = True
        connection = self._client.socket()
        self._client.disconnect()
        timer = threading.Timer(_LINGER_S, _shut, (connection,))  # loop_stop waits for the socket, without a limit
        timer.start()
        # While it connects there is no socket yet, and the client waits for that alone; its thread ends by itself then.
        stopping = threading.Thread(target=self._client.loop_stop, name="MQTT stops", daemon=True)
        stopping.start()
        stopping.join(_LINGER_S if connection is None else None)
        timer.cancel()
        timer.join()
        if not stopping.is_alive():
            # It closes its own sockets when nothing refers to it: not only when a garbage collector finds the circle.
            client = self._client
            client.on_connect = client.on_disconnect = client.on_subscribe = client.on_message = None
            client.on_publish = client.on_connect_fail = None

    def _connected(self, client: Client, _user: Any, flags: Any, reason: Any, answer: Any) -> None:
        self._answered = True
        if self._closing:
            client.disconnect()
            return
        if reason.is_failure:
            self._events.lost(f"the broker refuses the connection ({reason})")
            return
        self._number, self._up = self._number + 1, True
        before, self._largest = self._largest, getattr(answer, "MaximumPacketSize", 0)
        if self._largest > 0 and (self._largest < before or not before):
            # Each message that is too large now would end the connection, first of all of each one that follows; both
            # ends repeat by themselves what has no answer.
            client.drop_out_messages()
        self._fresh = not flags.session_present
        client.subscribe([(topic, _at_least_once()) for topic in self._session.topics])

    def _subscribed(self, client: Client, _user: Any, _mid: int, reasons: list[Any], _properties: Any) -> None:
        if any(reason.is_failure for reason in reasons):
            self._events.lost(f"the broker refuses a subscription ({', '.join(map(str, reasons))})")
            client.disconnect()
            return
        self._events.ready(self._fresh)

    def _disconnected(self, _client: Client, _user: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if self._closing:
            return
        if reason.value == _SILENT and not flags.is_disconnect_packet_from_server:  # this end has given up
            self._events.lost(f"the broker has not answered for {_KEEP_ALIVE_S} s: it, or the network between, hangs")
        elif self._up:
            self._events.lost(f"the connection to the broker broke ({reason})")
        elif not self._answered:
            self._events.lost(f"the broker ended the connection before it answered{self._hint}")
        self._up = self._answered = False

    def _failed(self, _client: Client, _user: Any) -> None:
        if self._closing:
            return
        # Here, as ssl in `url`: the edge's control process, which knows brokers from its file only, does without it.
        from servotwin.link.connection_errors import cause_of, is_of_certificate

        # paho calls this while it handles the exception, which it does not pass on.
        error, broker = sys.exc_info()[1], self._broker
        if self._context is not None and is_of_certificate(error):
            read_again(self._context, broker.ca_file)  # for the next try: its file may have been renewed
        self._events.lost(f"the broker cannot be reached ({cause_of(error, broker.tls, broker.ca_file)})")

    def _published(self, _client: Client, _user: Any, mid: int, reason: Any, _properties: Any) -> None:
        if reason.value == _NO_SUBSCRIBERS:
            self._events.not_delivered(mid, "")
        elif reason.is_failure:
            self._events.not_delivered(mid, f"the broker refuses what this user sends ({reason})")

    def _message(self, _client: Client, _user: Any, message: MQTTMessage) -> None:
        number, mid, qos = self._number, message.mid, message.qos

        def acknowledge() -> None:
            if number == self._number:  # message ids begin again with each connection
                self._client.ack(mid, qos)

        self._events.message(message.topic, bytes(message.payload), acknowledge)


_OVERHEAD = 64
"""Bytes of a packet beside topic and payload, at most; about 20 are usual."""
_NO_SUBSCRIBERS = 0x10
"""MQTT's reason code "no matching subscribers"."""
_SILENT = 0x8D
"""MQTT's reason code "keep alive timeout"."""
_NO_CONNECTION = 4
"""paho's code for a message that is queued until there is a connection."""


def _import_paho() -> None:
    try:
        import paho.mqtt.client  # noqa: F401
    except ModuleNotFoundError:
        raise missing_extra("paho", "the link over MQTT") from None


def _client(broker: Broker, session: MqttSession, context: ssl.SSLContext | None) -> Client:
    _import_paho()
    from paho.mqtt.client import Client, MQTTv5
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2, session.client_id, protocol=MQTTv5, manual_ack=True)
    client.max_queued_messages_set(_MOST_QUEUED)
    client.max_inflight_messages_set(session.receive)
    client.reconnect_delay_set(1, 4)
    if broker.user is not None:
        client.username_pw_set(broker.user, broker.password)
    if context is not None:
        client.tls_set_context(context)
    if session.will:
        client.will_set(session.will, b"", qos=1)
    return client


def _connect_properties(session: MqttSession) -> Any:
    return _properties("CONNECT", SessionExpiryInterval=session.session_s, ReceiveMaximum=session.receive)


def _properties(packet: str, **values: int) -> Any:
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    properties: Any = Properties(getattr(PacketTypes, packet))  # type: ignore[no-untyped-call]
    for name, value in values.items():
        setattr(properties, name, value)
    return properties


def _at_least_once() -> Any:
    from paho.mqtt.subscribeoptions import SubscribeOptions

    return SubscribeOptions(qos=1)


def _no_delay(_client: Any, _user: Any, connection: Any) -> None:
    # Without it a round trip on one machine took 88 ms: every small packet waits for TCP's ACK of the last one.
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _shut(connection: Any) -> None:
    try:
        if connection is not None:
            connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        return
