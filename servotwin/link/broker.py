"""A connection to an MQTT 5 broker that comes back by itself; what both ends of the link over MQTT stand on.

Needs paho-mqtt (extra `mqtt`), which is imported when a connection is made.
"""

from __future__ import annotations

import socket
import ssl
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from servotwin.errors import InvalidInput
from servotwin.runtime.extras import missing_extra

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessage

SCHEMES = {"mqtt": 1883, "mqtts": 8883}
KEEP_ALIVE_S = 20
"""A connection over which nothing comes for half as long again is given up."""
QUEUED = 10_000
"""Messages that wait for the broker at most."""
LINGER_S = 1.0
"""For a last word when the connection is let go."""


@dataclass(frozen=True, slots=True)
class Broker:
    """Address of a broker, and the credentials there.

    Parameters
    ----------
    url : str
        mqtt(s)://host[:port].
    user : str, optional
    password : str, optional
        Not shown.
    ca_file : str, optional
        Certificates that the broker's is checked against; None: the system's.
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
        return parts.hostname or "", parts.port or SCHEMES[parts.scheme]


def is_mqtt(url: str) -> bool:
    """True for a broker's address: mqtt(s)://host[:port]."""
    try:
        parts = urlsplit(url)
        plain = parts.path in ("", "/") and not (parts.query or parts.fragment) and parts.username is None
        return parts.scheme in SCHEMES and bool(parts.hostname) and plain and parts.port != 0
    except ValueError:
        return False


class MqttSession(NamedTuple):
    """Session at a broker: client, topics, expiry.

    Attributes
    ----------
    client_id : str
        The broker knows a session by it.
    topics : tuple of str
        Subscribed to, at least once each.
    session_s : int
        How long the broker keeps a session, and what comes for it, when its connection broke.
    receive : int
        Messages under way to this end that are not acknowledged yet.
    will : str
        Topic of what the broker says when the connection breaks; empty: nothing.
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
        Topic, payload, and what acknowledges it to the broker (from any thread; without effect on a later connection).
    ready : callable
        Subscribed; whether the broker has forgotten the session.
    lost : callable
        The connection broke or was refused, and why.
    unheard : callable
        The broker took the message of that number, but nobody has subscribed to its topic.
    """

    message: Callable[[str, bytes, Callable[[], None]], None]
    ready: Callable[[bool], None]
    lost: Callable[[str], None]
    unheard: Callable[[int], None] = lambda _: None


class Connection:
    """Kept up until it is closed.

    Parameters
    ----------
    broker : Broker
    session : MqttSession
    events : MqttCallbacks
    """

    def __init__(self, broker: Broker, session: MqttSession, events: MqttCallbacks) -> None:
        self._wanted, self._events = session, events
        self._number, self._fresh, self._up, self._closing = 0, True, False, False
        self._client = _client(broker, session)
        self._client.on_socket_open = _no_delay
        self._client.on_connect, self._client.on_disconnect = self._connected, self._disconnected
        self._client.on_subscribe, self._client.on_message = self._subscribed, self._message
        self._client.on_publish = self._published
        self._client.on_connect_fail = self._failed
        self._client.connect_async(
            *broker.address, keepalive=KEEP_ALIVE_S, clean_start=False, properties=_connect_properties(session)
        )
        self._client.loop_start()

    def publish(self, topic: str, payload: bytes, expiry_s: float) -> int | None:
        """Send at least once, while anybody may still want it; its number, None where too much waits already."""
        properties = _properties("PUBLISH", MessageExpiryInterval=max(1, round(expiry_s)))
        info = self._client.publish(topic, payload, qos=1, properties=properties)
        return info.mid if info.rc in (0, _NO_CONNECTION) else None

    def close(self) -> None:
        """Say good-bye and let go; a broker that does not listen is waited for no longer than a moment."""
        self._closing = True
        line = self._client.socket()
        self._client.disconnect()
        cut = threading.Timer(LINGER_S, _shut, (line,))
        cut.start()
        self._client.loop_stop()
        cut.cancel()
        cut.join()

    def _connected(self, client: Client, _user: Any, flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._events.lost(f"the broker refuses the connection ({reason})")
            return
        self._number, self._up = self._number + 1, True
        self._fresh = not flags.session_present
        client.subscribe([(topic, _at_least_once()) for topic in self._wanted.topics])

    def _subscribed(self, client: Client, _user: Any, _mid: int, reasons: list[Any], _properties: Any) -> None:
        if any(reason.is_failure for reason in reasons):
            self._events.lost(f"the broker refuses a subscription ({', '.join(map(str, reasons))})")
            client.disconnect()
            return
        self._events.ready(self._fresh)

    def _disconnected(self, _client: Client, _user: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if self._up and not self._closing:
            self._events.lost(f"the connection to the broker broke ({reason})")
        self._up = False

    def _failed(self, _client: Client, _user: Any) -> None:
        """Called while the exception is being handled, which paho does not pass on."""
        self._events.lost(f"the broker cannot be reached ({sys.exc_info()[1]})")

    def _published(self, _client: Client, _user: Any, mid: int, reason: Any, _properties: Any) -> None:
        if reason.value == _NO_SUBSCRIBERS:
            self._events.unheard(mid)

    def _message(self, _client: Client, _user: Any, message: MQTTMessage) -> None:
        number, mid, qos = self._number, message.mid, message.qos

        def acknowledge() -> None:
            if number == self._number:
                self._client.ack(mid, qos)

        self._events.message(message.topic, bytes(message.payload), acknowledge)


_NO_SUBSCRIBERS = 0x10
"""MQTT's reason code of a message that nobody gets."""
_NO_CONNECTION = 4
"""paho's code: the message is kept and sent when there is a connection."""


def _client(broker: Broker, session: MqttSession) -> Client:
    try:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion
    except ModuleNotFoundError:
        raise missing_extra("paho", "the link over MQTT") from None
    client = Client(CallbackAPIVersion.VERSION2, session.client_id, protocol=MQTTv5, manual_ack=True)
    client.max_queued_messages_set(QUEUED)
    client.max_inflight_messages_set(session.receive)
    client.reconnect_delay_set(1, 4)
    if broker.user is not None:
        client.username_pw_set(broker.user, broker.password)
    if broker.tls:
        client.tls_set_context(_context(broker.ca_file))
    if session.will:
        client.will_set(session.will, b"", qos=1)
    return client


def _context(ca_file: str | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        raise InvalidInput(f"{ca_file}: holds no certificates that can be read ({error})") from None


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


def _no_delay(_client: Any, _user: Any, line: Any) -> None:
    """Measured without it: 88 ms there and back on one machine, since every small packet waits for an ACK of TCP."""
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _shut(line: Any) -> None:
    try:
        if line is not None:
            line.shutdown(socket.SHUT_RDWR)
    except OSError:
        return
