"""What edge and twin say to each other over a broker: question and answer, both sealed, known by a serial.

A broker only passes messages on, so that a token must not be shown to it: whoever can seal a question for a servo has
the servo's token. An answer is sealed with the serial of its question, so that nobody can repeat an old one.

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
GONE = f"{ROOT}/gone"
UP = f"{ROOT}/+/up"
ANSWER = "answer to edge"
LIMIT = 4 * MAX_BYTES + 2 * OVERHEAD
"""Bytes of the largest answer: as many messages as one answer over HTTP holds."""
_UP = re.compile(ROOT + r"/([A-Za-z0-9][A-Za-z0-9._-]{0,63})/up")


class Carry(Struct, frozen=True, tag="carry/1"):
    """Question: keep this message.

    Attributes
    ----------
    body : bytes
        Encoded, then compressed as `encoding` says.
    encoding : str
        As HTTP's Content-Encoding; nothing stands for identity.
    """

    body: bytes
    encoding: Annotated[str, Meta(max_length=16)] = ""


class Listen(Struct, frozen=True, tag="listen/1"):
    """Question: which messages are there for me?

    Attributes
    ----------
    after : int
        Only those of higher serials.
    wait : float
        s to wait for the first one.
    """

    after: Count
    wait: Annotated[float, Meta(ge=0.0, le=30.0)]


class Taken(Struct, frozen=True, tag="taken/1"):
    """Answer: the message is kept, now or from before."""


class Heard(Struct, frozen=True, tag="heard/1"):
    """Answer: these messages, each sealed, serials rising."""

    messages: list[bytes]


class NotTaken(Struct, frozen=True, tag="refused/1"):
    """Answer: no.

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


class Stranger(Struct, frozen=True, tag="stranger/1"):
    """Answer to a question whose seal was not that of the servo's token; not sealed, and no reason to drop anything."""

    serial: Count


Question = Carry | Listen
Answer = Taken | Heard | NotTaken


class Asked(NamedTuple):
    """A question that came whole."""

    servo: str
    serial: int
    question: Question


_question: msgspec.msgpack.Decoder[Question] = msgspec.msgpack.Decoder(Question)
_answer: msgspec.msgpack.Decoder[Answer] = msgspec.msgpack.Decoder(Answer)
_down: msgspec.msgpack.Decoder[Sealed | Stranger] = msgspec.msgpack.Decoder(Sealed | Stranger)
_encode = msgspec.msgpack.Encoder().encode


def up(servo: str) -> str:
    """Where a servo's edge asks."""
    return f"{ROOT}/{servo}/up"


def down(servo: str) -> str:
    """Where it is answered."""
    return f"{ROOT}/{servo}/down"


def servo_of(topic: str) -> str | None:
    """Whose edge asks there; None: nobody's."""
    found = _UP.fullmatch(topic)
    return None if found is None else found.group(1)


def ask(key: bytes, servo: str, serial: int, question: Question) -> bytes:
    """The question's bytes."""
    return seal(key, TO_TWIN, servo, serial, _encode(question))


def asked(key: bytes, servo: str, data: bytes) -> Asked:
    """The question in these bytes; raises InvalidMessage as `seal.opened` does, or where it is none."""
    found = opened(key, TO_TWIN, servo, data, MAX_BYTES + OVERHEAD)
    try:
        return Asked(servo, found.serial, _question.decode(found.body))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidMessage(f"question not understood: {error}") from None


def answer(key: bytes, servo: str, serial: int, said: Answer) -> bytes:
    """The bytes of an answer to the question of that serial."""
    return seal(key, ANSWER, servo, serial, _encode(said))


def stranger(data: bytes) -> bytes | None:
    """The answer to a question whose seal is broken; None where not even its serial can be read."""
    found = _read(data, MAX_BYTES + 2 * OVERHEAD)
    return _encode(Stranger(found.serial)) if isinstance(found, Sealed) else None


def answered(key: bytes, servo: str, data: bytes) -> tuple[int, Answer | Stranger]:
    """The serial of a question, and the answer to it; raises InvalidMessage where the bytes are no good."""
    found = _read(data, LIMIT + OVERHEAD)
    if isinstance(found, Stranger):
        return found.serial, found
    whole = opened(key, ANSWER, servo, data, LIMIT)
    try:
        return whole.serial, _answer.decode(whole.body)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidMessage(f"answer not understood: {error}") from None


def _read(data: bytes, limit: int) -> Sealed | Stranger | None:
    """None: neither, or too large to look at."""
    try:
        return _down.decode(data) if len(data) <= limit else None
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
