"""Messages sealed with a key that edge and twin share: whoever carries them can neither change nor repeat them.

Both make the key of the servo's token: the edge knows the token, the twin only a digest of it (the verifier).
"""

import hmac
from hashlib import sha256
from struct import pack
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from servotwin.messages import InvalidMessage, Refusal
from servotwin.messages.checks import Count, Name, require

TO_EDGE, TO_TWIN = "to edge", "to twin"
MAC_BYTES = 32
OVERHEAD = 256
"""Bytes that a seal adds to a message at most."""


class Sealed(Struct, frozen=True, tag="sealed/1"):
    """A message with proof of where it comes from.

    Attributes
    ----------
    servo : str
    serial : int
        Rises with every message of its direction: a repeated one is seen.
    body : bytes
        The message.
    mac : bytes
        HMAC-SHA256 over direction, servo, serial and body.
    """

    servo: Name
    serial: Count
    body: bytes
    mac: Annotated[bytes, Meta(min_length=MAC_BYTES, max_length=MAC_BYTES)]


_decoder = msgspec.msgpack.Decoder(Sealed)


def verifier_of(token: str) -> bytes:
    """Verifier of a token, which the twin keeps: enough to check it and to seal, not to send it elsewhere."""
    return sha256(b"servotwin token\0" + token.encode()).digest()


def key_of(verifier: bytes) -> bytes:
    """The key that seals the messages of the servo whose token has that verifier."""
    return hmac.digest(verifier, b"servotwin seal/1", "sha256")


def seal(key: bytes, direction: str, servo: str, serial: int, body: bytes) -> bytes:
    """The sealed message's bytes."""
    return msgspec.msgpack.encode(Sealed(servo, serial, body, _mac(key, direction, servo, serial, body)))


def opened(key: bytes, direction: str, servo: str, data: bytes, limit: int) -> Sealed:
    """The sealed message, once its seal is found whole.

    Raises
    ------
    InvalidMessage
        Too large, not a sealed message, another servo's, or the seal is broken.
    """
    most = limit + OVERHEAD
    require(len(data) <= most, f"sealed message of {len(data)} bytes: at most {most} are allowed", Refusal.TOO_LARGE)
    try:
        found = _decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidMessage(f"sealed message not understood: {error}") from None
    require(found.servo == servo, f"sealed message is for servo {found.servo!r}, not {servo!r}")
    whole = hmac.compare_digest(found.mac, _mac(key, direction, servo, found.serial, found.body))
    require(whole, "the seal of a message is broken: another token, or it was changed on its way")
    return found


def _mac(key: bytes, direction: str, servo: str, serial: int, body: bytes) -> bytes:
    head = f"{direction}\0{servo}\0".encode() + pack("<Q", serial)
    return hmac.digest(key, head + body, "sha256")
