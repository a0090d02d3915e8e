"""Encoding, compression and decoding of messages; anything wrong with the bytes raises InvalidMessage.

The sizes of a message and of a decompressed body are bounded before anything is parsed.
"""

import zlib
from typing import cast, get_args

import msgspec

from servotwin.messages.checks import InvalidMessage, Refusal, require
from servotwin.messages.claims import ClaimStatus, EdgeClaim
from servotwin.messages.legacy import LEGACY_TAGS, MAX_LEGACY_BYTES, upgrade
from servotwin.messages.requests import Answer, Request, Resend
from servotwin.messages.responses import LearntResponse
from servotwin.messages.updates import Fallback, Receipt, Update, UpdateWithNeeds
from servotwin.messages.windows import Acknowledge, Hello, LetterAcknowledge, WindowMessage, checksum

MAX_BYTES = 4 * 1024 * 1024
"""Largest message that is decoded: 1 s of four channels at 5 kHz takes 40 kB."""

IDENTITY, DEFLATE, ZSTD = "", "deflate", "zstd"
ENCODINGS = (IDENTITY, DEFLATE, ZSTD)
"""Names as in HTTP's Content-Encoding; the empty one is identity."""
_ZSTD_WINDOW = 8 * 1024 * 1024
"""Bytes of memory that a zstd frame may require of its reader: the limit that RFC 8878 recommends."""

ParameterMessage = (
    Update
    | UpdateWithNeeds
    | Receipt
    | Fallback
    | Request
    | Answer
    | Hello
    | Acknowledge
    | LetterAcknowledge
    | LearntResponse
    | Resend
    | EdgeClaim
    | ClaimStatus
)
Message = WindowMessage | ParameterMessage


class _Tagged(msgspec.Struct):
    """Tag of a message."""

    type: str


_UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError, OverflowError)
_SCHEMAS = frozenset(kind.__struct_config__.tag for kind in get_args(Message))
_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)


def encode(message: Message) -> bytes:
    """Encode a message as it is sent (MessagePack)."""
    return _encoder.encode(_as_sent(message))


def decode(data: bytes, limit: int = MAX_BYTES) -> Message:
    """Decode a message.

    Raises
    ------
    InvalidMessage
        Too large (seen before anything is parsed), not MessagePack, unknown tag, bad field, wrong checksum.
    """
    message = _as_read(_guarded(data, limit))
    if isinstance(message, WindowMessage):
        whole = message.crc == checksum(message.channels)
        require(whole, "window checksum does not match its channels", Refusal.BAD_CHECKSUM)
    return message


def _as_sent(message: Message) -> Message:
    """Give an update that has needs the tag that edges which do not read them take for unknown."""
    if type(message) is Update and message.needs:
        return UpdateWithNeeds(**{name: getattr(message, name) for name in message.__struct_fields__})
    return message


def _as_read(message: Message) -> Message:
    if isinstance(message, UpdateWithNeeds):
        return Update(**{name: getattr(message, name) for name in message.__struct_fields__})
    return message


def _guarded(data: bytes, limit: int) -> Message:
    """Decode; anything wrong with the bytes raises InvalidMessage."""
    require(len(data) <= limit, f"message of {len(data)} bytes: at most {limit} are allowed", Refusal.TOO_LARGE)
    try:
        return _decoder.decode(data)
    except InvalidMessage:
        raise
    except _UNREADABLE as error:
        # The slow path: only bytes that no present schema decodes can be a message of the version before.
        try:
            tag = msgspec.msgpack.decode(data, type=_Tagged).type
            if tag in LEGACY_TAGS and len(data) <= MAX_LEGACY_BYTES:
                return cast(Message, msgspec.convert(upgrade(msgspec.msgpack.decode(data)), Message))
        except _UNREADABLE as again:
            raise InvalidMessage(f"message not understood: {again}") from None
        refusal = Refusal.NOT_UNDERSTOOD if tag in _SCHEMAS else Refusal.UNKNOWN_SCHEMA
        raise InvalidMessage(f"message not understood: {error}", refusal) from None


def deflated(body: bytes) -> tuple[bytes, str]:
    """Deflate the body where that makes it smaller; return it and its encoding."""
    smaller = zlib.compress(body, 1)
    return (smaller, DEFLATE) if len(smaller) < len(body) else (body, IDENTITY)


def compress(data: bytes, encoding: str) -> bytes:
    """Compress with an encoding; "zstd" needs zstandard."""
    if encoding == DEFLATE:
        return zlib.compress(data, 6)
    if encoding == ZSTD:
        from zstandard import ZstdCompressor

        return ZstdCompressor().compress(data)
    return data


def decompress(data: bytes, encoding: str, limit: int) -> bytes:
    """Decompress; never more than `limit` bytes are produced.

    Raises
    ------
    InvalidMessage
        Unknown encoding, not of that encoding, cut short, followed by something else, or larger than `limit`.
    """
    require(encoding in ENCODINGS, f"content encoding {encoding[:32]!r}: known are deflate and zstd")
    if encoding == DEFLATE:
        return _inflated(data, limit)
    if encoding == ZSTD:
        return _unzstd(data, limit)
    require(len(data) <= limit, _too_large(limit), Refusal.TOO_LARGE)
    return data


def _inflated(data: bytes, limit: int) -> bytes:
    reader = zlib.decompressobj()
    try:
        inflated = reader.decompress(data, limit + 1)
    except zlib.error as error:
        raise InvalidMessage(f"body is not deflate: {error}") from None
    require(len(inflated) <= limit, _too_large(limit), Refusal.TOO_LARGE)
    require(reader.eof and not reader.unused_data, "body is not deflate: cut short, or followed by something else")
    return inflated


def _unzstd(data: bytes, limit: int) -> bytes:
    """Decompress a frame that declares its size; one without is refused, so that nothing too large is ever started."""
    import zstandard

    try:
        size = zstandard.frame_content_size(data)
        require(size >= 0, "body is not zstd: its frame does not say how many bytes it holds")
        require(size <= limit, _too_large(limit), Refusal.TOO_LARGE)
        reader = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW)
        return reader.decompress(data, max_output_size=max(1, size), read_across_frames=False, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise InvalidMessage(f"body is not zstd: {error}") from None


def _too_large(limit: int) -> str:
    return f"body holds more than {limit} bytes"
