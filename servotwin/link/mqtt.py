"""Link over an MQTT 5 broker: the same guarantees as over HTTP, whatever the broker forgets.

A window counts as delivered when a twin has answered that it is committed; that the broker has it means nothing. What
is not answered is asked again by whoever keeps the windows. The twin's messages are asked for by serial, so that
none is missed while the broker, or the edge, is away.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from itertools import count
from threading import Event, Lock

from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.mqtt_messages import (
    TWIN_GONE,
    MqttRequest,
    MqttResponse,
    PollRequest,
    PollResponse,
    PutRequest,
    PutResponse,
    RefusedResponse,
    UnknownPeer,
    decode_response,
    encode_request,
    request_topic,
    response_topic,
)
from servotwin.link.seal import key_of, verifier_of
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.messages import MAX_BYTES, InvalidMessage, Refusal

SESSION_S = 3600
NO_SUBSCRIBER = "no twin listens at the broker"


class MqttTransport:
    """One servo's link to its twins over a broker.

    Parameters
    ----------
    broker : Broker
    servo, token : str
        The token is never sent: it seals.
    timeout_s : float
        For an answer, s.
    wait_s : float
        How long one poll waits, s.
    """

    def __init__(self, broker: Broker, servo: str, token: str, timeout_s: float = 10.0, wait_s: float = 25.0) -> None:
        self._servo, self._key = servo, key_of(verifier_of(token))
        self._timeout, self._wait = timeout_s, wait_s
        # Beginning anywhere, so that no answer to an earlier process is taken for one to this.
        self._serials, self._lock = count(secrets.randbits(52)), Lock()
        self._waiting: dict[int, Future[MqttResponse | UnknownPeer]] = {}
        self._sent: dict[int, Future[MqttResponse | UnknownPeer]] = {}
        self._unheard: set[int] = set()
        self._ready, self._closed, self._why = Event(), False, "the broker has not answered yet"
        session = MqttSession(f"servotwin-edge-{servo}", (response_topic(servo), TWIN_GONE), SESSION_S)
        self._connection = Connection(
            broker, session, MqttCallbacks(self._message, self._connected, self._lost, self._no_subscriber)
        )

    def deliver(self, parcel: Parcel) -> None:
        """Return when a twin has the message safe; see `Transport`."""
        if len(parcel.body) > MAX_BYTES:
            raise Refused(Refusal.TOO_LARGE, f"a message of {len(parcel.body)} bytes: at most {MAX_BYTES} are allowed")
        response = self._request(PutRequest(parcel.body, parcel.encoding), self._timeout)
        if not isinstance(response, PutResponse):
            raise Unreachable("the answer to a message does not acknowledge it")

    def listen(self, after: int) -> list[bytes]:
        """The twin's messages with serials above `after`; see `Transport`."""
        response = self._request(PollRequest(after, self._wait), self._wait + self._timeout)
        if not isinstance(response, PollResponse):
            raise Unreachable("the answer to a poll holds no messages")
        return response.messages

    def close(self) -> None:
        """Let go of the connection."""
        self._closed = True
        self._give_up("the link is closed")
        self._ready.set()
        self._connection.close()

    def _request(self, request: MqttRequest, patience: float) -> MqttResponse:
        """The answer to a question; raises Refused and Unreachable."""
        if not self._ready.wait(self._timeout):
            raise Unreachable(self._why)
        serial, future = self._expect()
        number = 0
        try:
            number = self._send(encode_request(self._key, self._servo, serial, request), patience, future)
            response = future.result(patience)
        except TimeoutError:
            raise Unreachable(f"no answer of a twin within {patience:g} s") from None
        finally:
            with self._lock:
                del self._waiting[serial]
                self._sent.pop(number, None)
        if isinstance(response, UnknownPeer):
            raise Refused(Refusal.BAD_TOKEN, "the twin knows the servo by another token")
        if isinstance(response, RefusedResponse):
            raise Refused(response.code, response.detail, response.after_s)
        return response

    def _expect(self) -> tuple[int, Future[MqttResponse | UnknownPeer]]:
        serial, future = next(self._serials), Future[MqttResponse | UnknownPeer]()
        with self._lock:
            self._waiting[serial] = future
        return serial, future

    def _send(self, data: bytes, patience: float, future: Future[MqttResponse | UnknownPeer]) -> int:
        """Publish a question; the broker may have response that nobody hears it before its number is known here."""
        number = None if self._closed else self._connection.publish(request_topic(self._servo), data, patience)
        if number is None:
            raise Unreachable("the link is closed" if self._closed else "too much waits for the broker")
        with self._lock:
            self._sent[number] = future
            unheard = number in self._unheard
            self._unheard.discard(number)
        if unheard:
            _set_result(future, Unreachable(NO_SUBSCRIBER))
        return number

    def _no_subscriber(self, number: int) -> None:
        with self._lock:
            future = self._sent.get(number)
            if future is None:
                self._unheard.add(number)
        if future is not None:
            _set_result(future, Unreachable(NO_SUBSCRIBER))

    def _message(self, topic: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
        """Something came: an answer, or word that a twin is gone; what cannot be used is as if it had not come."""
        acknowledge()
        if topic == TWIN_GONE:
            self._give_up("a twin is gone")
            return
        try:
            serial, response = decode_response(self._key, self._servo, payload)
        except InvalidMessage:
            return
        with self._lock:
            future = self._waiting.get(serial)
        if future is not None:
            _set_result(future, response)

    def _connected(self, forgotten: bool) -> None:
        """A broker that has forgotten the session has forgotten the questions too."""
        if forgotten:
            self._give_up("the broker has forgotten this edge")
        self._ready.set()

    def _lost(self, why: str) -> None:
        """Questions under way stay: broker and edge go on with them when the connection is back."""
        self._why = why
        if not self._closed:
            self._ready.clear()

    def _give_up(self, why: str) -> None:
        with self._lock:
            waiting = list(self._waiting.values())
        for future in waiting:
            _set_result(future, Unreachable(why))


def _set_result(future: Future[MqttResponse | UnknownPeer], result: MqttResponse | UnknownPeer | Exception) -> None:
    """The first answer counts."""
    try:
        if isinstance(result, Exception):
            future.set_exception(result)
        else:
            future.set_result(result)
    except InvalidStateError:
        return
