"""Messages sealed with a key that edge and twin share: nobody between them can change or repeat a message.

Both derive the key from the servo's token: the edge knows the token, the twin only a digest of it (the verifier).
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
_MAC_BYTES = 32
OVERHEAD = 256
"""Largest number of bytes that a seal adds to a message."""
MAX_TOKEN = 1024
"""Characters of a token: a twin refuses longer ones unread."""


class Sealed(Struct, frozen=True, tag="sealed/1"):
    """A message with a code that authenticates its sender.

    Attributes
    ----------
    servo : str
    serial : int
        Rises with every message of its direction, so that a repeated one is detected.
    body : bytes
        Encoded message.
    mac : bytes
        HMAC-SHA256 over direction, servo, serial and body.
    """

    servo: Name
    serial: Count
    body: bytes
    mac: Annotated[bytes, Meta(min_length=_MAC_BYTES, max_length=_MAC_BYTES)]


_decoder = msgspec.msgpack.Decoder(Sealed)


def verifier_of(token: str) -> bytes:
    """Compute the verifier of a token; the twin stores it to check and to seal, and cannot recover the token."""
    # The prefix separates this digest from any other use of the token.
    return sha256(b"servotwin token\0" + token.encode()).digest()


def key_of(verifier: bytes) -> bytes:
    """Derive the key that seals the messages of the servo whose token has that verifier."""
    return hmac.digest(verifier, b"servotwin seal/1", "sha256")


def seal(key: bytes, direction: str, servo: str, serial: int, body: bytes) -> bytes:
    """Seal a message and encode it."""
    return msgspec.msgpack.encode(Sealed(servo, serial, body, _mac(key, direction, servo, serial, body)))


def opened(key: bytes, direction: str, servo: str, data: bytes, limit: int) -> Sealed:
    """Decode a sealed message and check its seal.

    Raises
    ------
    InvalidMessage
        The data are too large, not a sealed message, or for another servo, or the seal is broken.
    """
    most = limit + OVERHEAD
    require(len(data) <= most, f"sealed message of {len(data)} bytes: at most {most} are allowed", Refusal.TOO_LARGE)
    try:
        sealed = _decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidMessage(f"sealed message not understood: {error}") from None
    require(sealed.servo == servo, f"sealed message is for servo {sealed.servo!r}, not {servo!r}")
    # In constant time: how long `==` takes would tell a forger how many bytes are right.
    intact = hmac.compare_digest(sealed.mac, _mac(key, direction, servo, sealed.serial, sealed.body))
    require(intact, "the seal of a message is broken: another token, or it was changed on its way")
    return sealed


def _mac(key: bytes, direction: str, servo: str, serial: int, body: bytes) -> bytes:
    # The direction keeps a message from being returned to its sender as one of the other side. Names have no zero byte,
    # so that no two heads are equal.
    head = f"{direction}\0{servo}\0".encode() + pack("<Q", serial)
    return hmac.digest(key, head + body, "sha256")
