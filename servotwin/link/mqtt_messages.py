"""Requests and responses of edge and twin over a broker: both sealed, matched by a serial.

A broker only passes messages on, so that a token must not be shown to it: whoever can seal a request for a servo has
the servo's token. A response is sealed with the serial of its request, so that nobody can repeat an old one.

Topics: `servotwin/SERVO/up` to the twins, `servotwin/SERVO/down` back, `servotwin/gone` when a twin's connection broke.
"""

import re
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta, Struct

from servotwin.link.seal import OVERHEAD, TO_TWIN, Sealed, opened, seal
from servotwin.messages import MAX_BYTES, InvalidMessage, Refusal
from servotwin.messages.checks import Count

ROOT = "servotwin"
TWIN_GONE = f"{ROOT}/gone"
REQUEST_TOPICS = f"{ROOT}/+/up"
ANSWER = "answer to edge"
LIMIT = 4 * MAX_BYTES + 2 * OVERHEAD
"""Bytes of the largest answer: as many messages as one answer over HTTP holds."""
_UP = re.compile(ROOT + r"/([A-Za-z0-9][A-Za-z0-9._-]{0,63})/up")


class PutRequest(Struct, frozen=True, tag="carry/1"):
    """Request: store this message.

    Attributes
    ----------
    body : bytes
        Encoded, then compressed as `encoding` says.
    encoding : str
        As HTTP's Content-Encoding; nothing stands for identity.
    """

    body: bytes
    encoding: Annotated[str, Meta(max_length=16)] = ""


class PollRequest(Struct, frozen=True, tag="listen/1"):
    """Request: poll for messages.

    Attributes
    ----------
    after : int
        Only those of higher serials.
    wait : float
        s to wait for the first one.
    """

    after: Count
    wait: Annotated[float, Meta(ge=0.0, le=30.0)]


class PutResponse(Struct, frozen=True, tag="taken/1"):
    """Response: the message is stored, now or from before."""


class PollResponse(Struct, frozen=True, tag="heard/1"):
    """Response: messages, each sealed, serials rising."""

    messages: list[bytes]


class RefusedResponse(Struct, frozen=True, tag="refused/1"):
    """Response: the request is refused.

    Attributes
    ----------
    code : Refusal
    detail : str
        One sentence.
    after_s : float
        Nothing is to be asked before that time has gone by.
    """

    code: Refusal
    detail: Annotated[str, Meta(max_length=1000)]
    after_s: Annotated[float, Meta(ge=0.0, le=300.0)] = 0.0


class UnknownPeer(Struct, frozen=True, tag="stranger/1"):
    """Response to a request whose seal does not fit the servo's token; not sealed, and no reason to drop anything."""

    serial: Count


MqttRequest = PutRequest | PollRequest
MqttResponse = PutResponse | PollResponse | RefusedResponse


class ReceivedRequest(NamedTuple):
    """A request whose seal is whole."""

    servo: str
    serial: int
    question: MqttRequest


_question: msgspec.msgpack.Decoder[MqttRequest] = msgspec.msgpack.Decoder(MqttRequest)
_answer: msgspec.msgpack.Decoder[MqttResponse] = msgspec.msgpack.Decoder(MqttResponse)
_down: msgspec.msgpack.Decoder[Sealed | UnknownPeer] = msgspec.msgpack.Decoder(Sealed | UnknownPeer)
_encode = msgspec.msgpack.Encoder().encode


def request_topic(servo: str) -> str:
    """Topic of a servo's requests."""
    return f"{ROOT}/{servo}/up"


def response_topic(servo: str) -> str:
    """Topic of the responses to a servo."""
    return f"{ROOT}/{servo}/down"


def servo_of(topic: str) -> str | None:
    """Return the servo of a request topic; None: it is none."""
    found = _UP.fullmatch(topic)
    return None if found is None else found.group(1)


def encode_request(key: bytes, servo: str, serial: int, question: MqttRequest) -> bytes:
    """Encode and seal a request."""
    return seal(key, TO_TWIN, servo, serial, _encode(question))


def decode_request(key: bytes, servo: str, data: bytes) -> ReceivedRequest:
    """Decode a request; raises InvalidMessage as `seal.opened` does, or where it is none."""
    found = opened(key, TO_TWIN, servo, data, MAX_BYTES + OVERHEAD)
    try:
        return ReceivedRequest(servo, found.serial, _question.decode(found.body))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidMessage(f"question not understood: {error}") from None


def encode_response(key: bytes, servo: str, serial: int, said: MqttResponse) -> bytes:
    """Encode and seal the response to the request of that serial."""
    return seal(key, ANSWER, servo, serial, _encode(said))


def encode_unknown_peer(data: bytes) -> bytes | None:
    """Encode the response to a request whose seal is broken; None where not even its serial can be read."""
    found = _read(data, MAX_BYTES + 2 * OVERHEAD)
    return _encode(UnknownPeer(found.serial)) if isinstance(found, Sealed) else None


def decode_response(key: bytes, servo: str, data: bytes) -> tuple[int, MqttResponse | UnknownPeer]:
    """Decode a response and the serial of its request; raises InvalidMessage where the bytes are no good."""
    found = _read(data, LIMIT + OVERHEAD)
    if isinstance(found, UnknownPeer):
        return found.serial, found
    whole = opened(key, ANSWER, servo, data, LIMIT)
    try:
        return whole.serial, _answer.decode(whole.body)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidMessage(f"answer not understood: {error}") from None


def _read(data: bytes, limit: int) -> Sealed | UnknownPeer | None:
    """None: neither, or too large to look at."""
    try:
        return _down.decode(data) if len(data) <= limit else None
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
