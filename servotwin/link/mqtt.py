"""Link over an MQTT 5 broker: the same guarantees as over HTTP, whatever the broker forgets.

A window counts as delivered when a twin has responded that it is committed; the broker's own acknowledgement does not
count. The session repeats a request without a response. A poll names the serial after which it wants the twin's
messages, so that none is missed while the broker or the edge is away.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from itertools import count
from threading import Event, Lock
from typing import NamedTuple

from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.claim import HeldClaim
from servotwin.link.mqtt_messages import (
    TWIN_GONE,
    MqttRequest,
    MqttResponse,
    NotKnown,
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
from servotwin.link.round_trip import RoundTrip
from servotwin.link.seal import key_of, verifier_of
from servotwin.link.transport import LONGEST_OLDER_PAUSE_S, Parcel, Refused, Unreachable
from servotwin.messages import MAX_BYTES, ClaimStatus, EdgeClaim, InvalidMessage, Refusal
from servotwin.messages.live import LiveColumns, encode_live

_SESSION_S = 3600
_NO_MESSAGE = 2**53
"""Above every serial of a message."""
_NO_SUBSCRIBER = "no twin listens at the broker"
_MOST_UNANSWERED = 25
"""Requests and copies without an answer after which the connection is made anew: each may be a packet that was lost on
its way, and of such the broker and paho allow a hundred before they send none at all."""

_Answer = Future[MqttResponse | UnknownPeer]


class _Copy(NamedTuple):
    """One sending of a request, at `sent` (s); `measured`: the twin does not wait before it answers."""

    answer: _Answer
    sent: float
    measured: bool


class MqttTransport:
    """One servo's link to its twins over a broker.

    Parameters
    ----------
    broker : Broker
    servo, token : str
        The token is never sent: its key seals the messages.
    timeout_s : float
        Time limit of a response, s.
    wait_s : float
        Time for which one poll waits for a message, s.
    run : str
        Name of this run of the edge. It is part of the client's name: a broker that sees a name twice ends the older
        connection, and two edges of one servo would do that to each other for ever.
    session_s : int
        Time for which the broker keeps what it has for this end after its connection broke, s.
    """

    def __init__(
        self,
        broker: Broker,
        servo: str,
        token: str,
        timeout_s: float = 10.0,
        wait_s: float = 25.0,
        run: str = "",
        session_s: int = _SESSION_S,
    ) -> None:
        self._servo, self._key, self.claim = servo, key_of(verifier_of(token)), HeldClaim()
        self._timeout, self._wait = timeout_s, wait_s
        # Serials begin at random, so that a response to an earlier process does not match a request of this one.
        self._serials, self._lock = count(secrets.randbits(52)), Lock()
        self._waiting: dict[int, _Copy] = {}
        self._published: dict[int, _Answer] = {}
        self._sending, self._not_delivered = 0, dict[int, str]()
        self._round_trip, self._unanswered, self._losses = RoundTrip(timeout_s), 0, 0
        self._ready, self._closed, self._why = Event(), False, "the broker has not answered yet"
        name = f"servotwin-edge-{servo}" + (f"-{run}" if run else "")
        session = MqttSession(name, (response_topic(servo), TWIN_GONE), session_s)
        self._connection = Connection(
            broker, session, MqttCallbacks(self._message, self._connected, self._lost, self._undelivered)
        )

    def deliver(self, parcel: Parcel) -> float:
        """Return when a twin has the message safe; see `Transport`."""
        if len(parcel.body) > MAX_BYTES:
            raise Refused(Refusal.TOO_LARGE, f"a message of {len(parcel.body)} bytes: at most {MAX_BYTES} are allowed")
        response = self._request(PutRequest(parcel.body, parcel.encoding, self.claim.text, parcel.waiting))
        if not isinstance(response, PutResponse):
            raise Unreachable("the answer to a message does not acknowledge it")
        return min(response.older_pause, LONGEST_OLDER_PAUSE_S)

    def listen(self, after: int, at_once: bool = False) -> list[bytes]:
        """Return the twin's messages with serials above `after`; see `Transport`."""
        wait = 0.0 if at_once else self._wait
        response = self._request(PollRequest(after, wait, self.claim.text), wait)
        if not isinstance(response, PollResponse):
            raise Unreachable("the answer to a poll holds no messages")
        return response.messages

    def ask(self, claim: EdgeClaim) -> ClaimStatus | None:
        """Send a question or a claim; see `ClaimingTransport`."""
        # In a poll for messages that there cannot be: a twin without claims answers it like any other.
        response = self._request(PollRequest(_NO_MESSAGE, 0.0, question=claim))
        if not isinstance(response, PollResponse):
            raise Unreachable("the answer to a claim is none")
        return response.claim_status

    def stream(self, columns: LiveColumns, claim: HeldClaim) -> bool:
        """Send columns of a live view; see `LiveMqtt`."""
        wait = 0.0 if columns.columns else self._wait
        # In a poll, as a claim is: a twin of an earlier version answers it like any other.
        asked = PollRequest(_NO_MESSAGE, wait, claim.text, live=encode_live(columns))
        response = self._request(asked, wait)
        if not isinstance(response, PollResponse):
            raise Unreachable("the answer to a live view is none")
        if response.watched is None:
            raise Refused(Refusal.UNKNOWN_SCHEMA, "the twin is of a version without the live view over a broker")
        return response.watched

    def listen_anew(self) -> None:
        """Do nothing: every request is sent again until it is answered; see `Transport`."""

    def close(self) -> None:
        """Close the connection; requests under way raise `Unreachable`."""
        self._closed = True
        self._fail_all("the link is closed")
        self._ready.set()
        self._connection.close()

    def _request(self, request: MqttRequest, wait: float = 0.0) -> MqttResponse:
        """Send a request, with which the twin may wait, and return its response; raises Refused and Unreachable."""
        if not self._ready.wait(self._timeout):
            raise Unreachable(self._why)
        future = _Answer()
        try:
            response = self._answer(request, future, wait)
        finally:
            with self._lock:
                self._waiting = {serial: copy for serial, copy in self._waiting.items() if copy.answer is not future}
                self._published = {number: each for number, each in self._published.items() if each is not future}
        if isinstance(response, UnknownPeer):
            raise Refused(Refusal.BAD_TOKEN, "the twin knows the servo by another token")
        if isinstance(response, RefusedResponse):
            raise Refused(response.code, response.detail, response.after_s)
        return response

    def _answer(self, request: MqttRequest, future: _Answer, wait: float) -> MqttResponse | UnknownPeer:
        """Send a request, and again after one round trip without an answer, two more, four ...; any answer counts."""
        patience, pause = wait + self._timeout, self._round_trip.wait_s
        until, copies, losses = time.monotonic() + patience, 0, self._losses
        while (left := until - time.monotonic()) > 0.0:
            if copies == 0 or self._ready.is_set():  # what is on its way is sent again once there is a connection
                self._send(request, future, left, measured=wait == 0.0)
                copies += 1
            with suppress(TimeoutError):
                return future.result(min(left, wait + pause))
            self._missed()
            pause *= 2.0
        meanwhile = f": {self._why}" if self._losses > losses else ""
        raise Unreachable(f"no answer of a twin within {patience:g} s{meanwhile}")

    def _missed(self) -> None:
        """Note that a copy of a request was not answered; make the connection anew after a number of them."""
        with self._lock:
            self._unanswered += 1
            renew = self._unanswered >= _MOST_UNANSWERED
            self._unanswered = 0 if renew else self._unanswered
        if renew:
            self._connection.renew()

    def _send(self, request: MqttRequest, future: _Answer, patience: float, measured: bool) -> None:
        """Publish a copy of a request; its own serial tells which copy an answer belongs to."""
        serial = next(self._serials)
        data = encode_request(self._key, self._servo, serial, request)
        with self._lock:
            self._waiting[serial] = _Copy(future, time.monotonic(), measured)
            self._sending += 1
        number, why = None, None
        try:
            number = None if self._closed else self._connection.publish(request_topic(self._servo), data, patience)
        finally:
            with self._lock:
                self._sending -= 1
                if number is not None:
                    self._published[number] = future
                    # The broker may report this before `publish` has returned the number.
                    why = self._not_delivered.pop(number, None)
                if not self._sending:  # what is left is of copies that nobody waits for; their numbers come again
                    self._not_delivered.clear()
        if number is None:
            raise Unreachable("the link is closed" if self._closed else "too much waits for the broker")
        if why is not None:
            _set_result(future, Unreachable(why))

    def _undelivered(self, number: int, why: str) -> None:
        why = why or _NO_SUBSCRIBER
        with self._lock:
            future = self._published.get(number)
            if future is None and self._sending:
                self._not_delivered[number] = why
        if future is not None:
            _set_result(future, Unreachable(why))

    def _message(self, topic: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
        """Handle a response, or the news that a twin is gone; ignore anything else."""
        # The broker need not repeat it: a response that gets lost here is requested again.
        acknowledge()
        if topic == TWIN_GONE:
            # It may have been the one with the request: the session repeats it now instead of after its time limit.
            self._fail_all("a twin is gone")
            return
        response: MqttResponse | UnknownPeer | Unreachable
        try:
            serial, response = decode_response(self._key, self._servo, payload)
        except NotKnown as newer:
            serial, response = newer.serial, Unreachable(f"this edge does not know the twin's answer: {newer}")
        except InvalidMessage:
            return
        with self._lock:
            copy = self._waiting.get(serial)
            if copy is not None and copy.measured:
                self._round_trip.answered(time.monotonic() - copy.sent)
        if copy is not None:
            _set_result(copy.answer, response)

    def _connected(self, forgotten: bool) -> None:
        """Fail the requests under way where the broker has forgotten the session, and them with it."""
        with self._lock:
            self._unanswered = 0
        if forgotten:
            self._fail_all("the broker has forgotten this edge")
        self._ready.set()

    def _lost(self, why: str) -> None:
        """Keep the requests under way: broker and edge go on with them when the connection is restored."""
        self._why, self._losses = why, self._losses + 1
        with self._lock:  # their answers will tell how long the connection was away
            self._waiting = {serial: copy._replace(measured=False) for serial, copy in self._waiting.items()}
        if not self._closed:
            self._ready.clear()

    def _fail_all(self, why: str) -> None:
        with self._lock:
            waiting = [copy.answer for copy in self._waiting.values()]
        for future in waiting:
            _set_result(future, Unreachable(why))


class LiveMqtt:
    """The live view's connection to a broker, beside that of windows and letters, which it cannot hold up.

    Parameters
    ----------
    broker, servo, token, timeout_s, wait_s, run
        As those of `MqttTransport`.
    """

    def __init__(self, broker: Broker, servo: str, token: str, timeout_s: float, wait_s: float, run: str) -> None:
        # What the broker would keep for it while it is away is old.
        self._transport = MqttTransport(broker, servo, token, timeout_s, wait_s, f"{run}-live", session_s=0)

    def send(self, columns: LiveColumns, claim: HeldClaim) -> bool:
        """Send columns; without any, wait until somebody watches. Return True while somebody does.

        Raises
        ------
        Refused, Unreachable
            Refused with UNKNOWN_SCHEMA: the twin is of a version without the live view over a broker.
        """
        return self._transport.stream(columns, claim)

    def close(self) -> None:
        """Close the connection; the request under way fails at once."""
        self._transport.close()


def _set_result(future: _Answer, result: MqttResponse | UnknownPeer | Exception) -> None:
    """Set the result of a future; where it has one already, that one counts."""
    try:
        if isinstance(result, Exception):
            future.set_exception(result)
        else:
            future.set_result(result)
    except InvalidStateError:
        return
