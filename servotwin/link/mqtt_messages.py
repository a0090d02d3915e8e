"""Requests and responses of edge and twin over a broker: both sealed, matched by a serial.

The broker passes messages on and must not see a token: a valid seal shows that the sender of a request has the servo's
token. A response is sealed with the serial of its request, so that nobody can repeat an old one.

Topics: `servotwin/SERVO/up` to the twins, `servotwin/SERVO/down` back, `servotwin/gone` when a twin's connection broke.
"""

import re
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta, Struct, field

from servotwin.link.seal import OVERHEAD, TO_TWIN, Sealed, opened, seal
from servotwin.messages import MAX_BYTES, ClaimStatus, EdgeClaim, InvalidMessage, Refusal
from servotwin.messages.checks import Count
from servotwin.messages.live import MAX_LIVE_BYTES

ROOT = "servotwin"
TWIN_GONE = f"{ROOT}/gone"
REQUEST_TOPICS = f"{ROOT}/+/up"
_TO_EDGE = "answer to edge"  # the direction is part of the seal: changing it breaks links between versions
LIMIT = 4 * MAX_BYTES + 2 * OVERHEAD
"""Bytes of the largest response: as many messages as one response over HTTP holds."""
_UP = re.compile(ROOT + r"/([A-Za-z0-9][A-Za-z0-9._-]{0,63})/up")


ClaimText = Annotated[str, Meta(max_length=96)]


class PutRequest(Struct, frozen=True, omit_defaults=True, tag="carry/1"):
    """Request: store this message.

    Attributes
    ----------
    body : bytes
        Encoded message, compressed as `encoding` says.
    encoding : str
        As HTTP's Content-Encoding; "" stands for identity.
    claim : str
        Claim that the sender holds; "": none.
    waiting : int
        Number of windows that the edge has to send beside this one. An earlier version ignores it.
    """

    body: bytes
    encoding: Annotated[str, Meta(max_length=16)] = ""
    claim: ClaimText = ""
    waiting: Count = 0


class PollRequest(Struct, frozen=True, omit_defaults=True, tag="listen/1"):
    """Request: poll for messages.

    Attributes
    ----------
    after : int
        Only messages with higher serials are requested.
    wait : float
        Time to wait for the first one, s.
    claim : str
        Claim that the sender holds; "": none.
    question : EdgeClaim, optional
        Question or claim, which is answered at once, without messages. A twin of a version without claims ignores it.
    live : bytes, optional
        Encoded columns of a live view, which are answered without messages: at once, or where there are none as soon as
        somebody watches. A twin of a version without live views over a broker ignores them.
    """

    after: Count
    wait: Annotated[float, Meta(ge=0.0, le=30.0)]
    claim: ClaimText = ""
    question: EdgeClaim | None = None
    live: Annotated[bytes, Meta(max_length=MAX_LIVE_BYTES)] | None = None


class PutResponse(Struct, frozen=True, omit_defaults=True, tag="taken/1"):
    """Response: the message is stored, by this request or an earlier one.

    `older_pause` is the pause (s) before each window that a newer one has overtaken. An earlier version ignores it.
    """

    older_pause: Annotated[float, Meta(ge=0.0, le=300.0)] = 0.0


class PollResponse(Struct, frozen=True, omit_defaults=True, tag="heard/1"):
    """Response: messages, each sealed, with rising serials.

    `claim_status` is the answer to a question, `watched` that to columns of a live view: True while somebody watches.
    """

    messages: list[bytes]
    claim_status: ClaimStatus | None = field(default=None, name="standing")
    watched: bool | None = None


class RefusedResponse(Struct, frozen=True, tag="refused/1"):
    """Response: the request is refused.

    Attributes
    ----------
    code : Refusal
    detail : str
        One sentence.
    after_s : float
        Time for which the edge shall send no request, s.
    """

    code: Refusal
    detail: Annotated[str, Meta(max_length=1000)]
    after_s: Annotated[float, Meta(ge=0.0, le=300.0)] = 0.0


class UnknownPeer(Struct, frozen=True, tag="stranger/1"):
    """Response to a request whose seal does not fit the servo's token.

    It is not sealed, so anybody may have sent it: the edge drops nothing because of it.
    """

    serial: Count


class NotKnown(InvalidMessage):
    """A message that its sender has sealed, and that this version does not know.

    Attributes
    ----------
    serial : int
        Of the request.
    """

    def __init__(self, text: str, serial: int) -> None:
        super().__init__(text, Refusal.UNKNOWN_SCHEMA)
        self.serial = serial


MqttRequest = PutRequest | PollRequest
MqttResponse = PutResponse | PollResponse | RefusedResponse


class ReceivedRequest(NamedTuple):
    """A request whose seal is intact."""

    servo: str
    serial: int
    content: MqttRequest


_request_decoder: msgspec.msgpack.Decoder[MqttRequest] = msgspec.msgpack.Decoder(MqttRequest)
_response_decoder: msgspec.msgpack.Decoder[MqttResponse] = msgspec.msgpack.Decoder(MqttResponse)
_envelope_decoder: msgspec.msgpack.Decoder[Sealed | UnknownPeer] = msgspec.msgpack.Decoder(Sealed | UnknownPeer)
_encode = msgspec.msgpack.Encoder().encode


def request_topic(servo: str) -> str:
    """Topic of a servo's requests."""
    return f"{ROOT}/{servo}/up"


def response_topic(servo: str) -> str:
    """Topic of the responses to a servo."""
    return f"{ROOT}/{servo}/down"


def servo_of(topic: str) -> str | None:
    """Return the servo of a request topic; None: it is not a request topic."""
    match = _UP.fullmatch(topic)
    return None if match is None else match.group(1)


def encode_request(key: bytes, servo: str, serial: int, request: MqttRequest) -> bytes:
    """Encode and seal a request."""
    return seal(key, TO_TWIN, servo, serial, _encode(request))


def decode_request(key: bytes, servo: str, data: bytes) -> ReceivedRequest:
    """Decode a request; raises InvalidMessage as `seal.opened` does, NotKnown for another body."""
    sealed = opened(key, TO_TWIN, servo, data, MAX_BYTES + OVERHEAD)
    try:
        return ReceivedRequest(servo, sealed.serial, _request_decoder.decode(sealed.body))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise NotKnown(f"request not understood: {error}", sealed.serial) from None


def encode_response(key: bytes, servo: str, serial: int, response: MqttResponse) -> bytes:
    """Encode and seal the response to the request of that serial."""
    return seal(key, _TO_EDGE, servo, serial, _encode(response))


def encode_unknown_peer(data: bytes) -> bytes | None:
    """Encode the response to a request whose seal is broken; None where not even its serial can be read."""
    envelope = _decode_envelope(data, MAX_BYTES + 2 * OVERHEAD)
    return _encode(UnknownPeer(envelope.serial)) if isinstance(envelope, Sealed) else None


def decode_response(key: bytes, servo: str, data: bytes) -> tuple[int, MqttResponse | UnknownPeer]:
    """Decode a response and the serial of its request; raises InvalidMessage and NotKnown as `decode_request`."""
    envelope = _decode_envelope(data, LIMIT + OVERHEAD)
    if isinstance(envelope, UnknownPeer):
        return envelope.serial, envelope
    sealed = opened(key, _TO_EDGE, servo, data, LIMIT)
    try:
        return sealed.serial, _response_decoder.decode(sealed.body)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise NotKnown(f"response not understood: {error}", sealed.serial) from None


def _decode_envelope(data: bytes, limit: int) -> Sealed | UnknownPeer | None:
    """Decode without a check of the seal; None: the bytes are neither, or too many to decode."""
    try:
        return _envelope_decoder.decode(data) if len(data) <= limit else None
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
