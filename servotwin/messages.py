"""What crosses the link, as bytes: windows, receipts and hellos to the twin, updates and acknowledgements to the edge.

MessagePack with a tag that carries the schema's version ("window/1"); an unknown tag is refused, unknown fields of a
known tag are ignored. A window's channels are planar int16 with a scale and an offset each. Parameter messages may be
JSON too. SI units throughout. Values that are not known, or bounds that do not exist, are None on the wire.
"""

import sys
from array import array
from collections.abc import Iterable
from enum import StrEnum
from math import isfinite
from struct import pack
from typing import Annotated, TypeVar
from zlib import crc32

import msgspec
from msgspec import Meta, Struct

MAX_BYTES = 4 * 1024 * 1024
"""Largest message that is looked at: 1 s of four channels at 5 kHz takes 40 kB."""

FINE = "_fine"
"""The name of a channel ends with this where it holds what the rounding of another one left."""
_LOWEST, _STEPS = -32768, 65535

NAME_PATTERN = r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z"
Name = Annotated[str, Meta(pattern=NAME_PATTERN)]
Text = Annotated[str, Meta(max_length=256)]
Count = Annotated[int, Meta(ge=0, le=2**53)]


class InvalidMessage(ValueError):
    """A message that must not be used, and what is wrong with it."""


class Reason(StrEnum):
    """What the edge did with an update."""

    APPLIED = "applied"
    WRONG_SERVO = "wrong servo"
    OTHER_BOOT = "stands on a window of another boot"
    OLD_VERSION = "version not newer than the one in force"
    BASE_MISMATCH = "base is not the version in force"
    OLD_DATA = "data not newer than that of the version in force"
    FUTURE_DATA = "data from the future"
    EXPIRED = "expired"
    OUT_OF_BOUNDS = "tolerance out of bounds"
    STEP_TOO_LARGE = "tolerance changes too much at once"
    TOO_SOON = "too soon after the previous update"


class Channel(Struct, frozen=True):
    """One recorded signal: sample k is offset + scale * code k.

    Attributes
    ----------
    name, unit : str
    scale, offset : float
        In `unit`; a constant channel has scale 0.
    data : bytes
        Codes as int16, little-endian.
    """

    name: Name
    unit: Text
    scale: float
    offset: float
    data: bytes

    def __post_init__(self) -> None:
        _require(isfinite(self.scale) and self.scale >= 0.0, f"channel {self.name}: scale {self.scale} is not allowed")
        _require(isfinite(self.offset), f"channel {self.name}: offset {self.offset} is not finite")
        _require(len(self.data) > 0 and len(self.data) % 2 == 0, f"channel {self.name}: not a number of int16 samples")

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.data) // 2


class Window(Struct, frozen=True, tag="window/1"):
    """A stretch of recorded samples, known by (servo, boot, sequence).

    Attributes
    ----------
    start : float
        Sample time of the first sample, s since the edge's boot.
    rate : float
        Hz.
    channels : tuple of Channel
        Equally long, names unique.
    reference_changes : tuple of (float, float)
        (sample time in s, new value in m) of changes inside the window.
    parameter_version : int
        In force when the window was cut.
    model_version, reason : str
        Which description of the servo the edge runs on; why the window was sent.
    crc : int
        `checksum(channels)`.
    """

    servo: Name
    boot: Name
    sequence: Count
    start: float
    rate: float
    channels: Annotated[tuple[Channel, ...], Meta(min_length=1, max_length=32)]
    reference_changes: Annotated[tuple[tuple[float, float], ...], Meta(max_length=4096)]
    parameter_version: Count
    model_version: Text
    reason: Text
    crc: Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]

    def __post_init__(self) -> None:
        _require(isfinite(self.start), f"window start {self.start} s is not finite")
        _require(isfinite(self.rate) and self.rate > 0.0, f"window rate {self.rate} Hz is not positive")
        _require(
            _all_finite(x for change in self.reference_changes for x in change), "a reference change is not finite"
        )
        _require(len({c.samples for c in self.channels}) == 1, "window channels differ in length")
        _require(len({c.name for c in self.channels}) == len(self.channels), "window channel names repeat")

    @property
    def identity(self) -> tuple[str, str, int]:
        """(servo, boot, sequence), unique for ever."""
        return self.servo, self.boot, self.sequence

    @property
    def samples(self) -> int:
        """Samples per channel."""
        return self.channels[0].samples

    def channel(self, name: str) -> Channel | None:
        """The channel of that name, if it was recorded."""
        return next((channel for channel in self.channels if channel.name == name), None)


class Update(Struct, frozen=True, tag="update/1"):
    """New parameters for the edge, and what they stand on.

    Attributes
    ----------
    version, base_version : int
        Its own number; the version it replaces (compare-and-swap).
    window : (str, int)
        (boot, sequence) of the window it stands on.
    data_time : float
        Sample time of that window's first sample, s.
    gap, std, interval : float, float, (float, float)
        The estimate, rad; None where unknown or unbounded.
    status : str
        The estimate's status.
    tolerance : float
        Dead-zone half-width, m; 0: no dead zone.
    not_after : float
        Sample time of the edge from which on it must not be applied, s.
    """

    servo: Name
    version: Annotated[int, Meta(ge=1, le=2**53)]
    base_version: Count
    window: tuple[Name, Count]
    data_time: float
    gap: float | None
    std: float | None
    interval: tuple[float | None, float | None]
    status: Text
    tolerance: float
    not_after: float

    def __post_init__(self) -> None:
        _require(isfinite(self.data_time), f"update data_time {self.data_time} s is not finite")
        _require(isfinite(self.not_after), f"update not_after {self.not_after} s is not finite")
        _require(
            isfinite(self.tolerance) and self.tolerance >= 0.0, f"update tolerance {self.tolerance} m is not allowed"
        )
        known = (x for x in (self.gap, self.std, *self.interval) if x is not None)
        _require(_all_finite(known), "update gap, std and interval must be finite, or None where unknown or unbounded")


class Receipt(Struct, frozen=True, tag="receipt/1"):
    """What the edge did with an update.

    Attributes
    ----------
    version : int
        The update's.
    applied : bool
    sample : int
        First sample under the new parameters, or the sample at which it was refused.
    reason : Reason
    parameter_version : int
        In force after the decision: what the twin has to base its next update on.
    boot : str
    """

    servo: Name
    version: Count
    applied: bool
    sample: Count
    reason: Reason
    parameter_version: Count
    boot: Name


class Hello(Struct, frozen=True, tag="hello/1"):
    """The edge introduces itself after a start or a reconnection; time is its sample time, s."""

    servo: Name
    boot: Name
    time: float
    rate: float
    parameter_version: Count
    tolerance: float
    model_version: Text

    def __post_init__(self) -> None:
        _require(_all_finite((self.time, self.rate, self.tolerance)), "hello time, rate and tolerance must be finite")


class Acknowledge(Struct, frozen=True, tag="ack/1"):
    """The twin has this window safe; the edge may forget it."""

    servo: Name
    boot: Name
    sequence: Count


ParameterMessage = Update | Receipt | Hello | Acknowledge
Message = Window | ParameterMessage
_Decoded = TypeVar("_Decoded")

_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)
_json_encoder = msgspec.json.Encoder()
_json_decoder: msgspec.json.Decoder[ParameterMessage] = msgspec.json.Decoder(ParameterMessage)


def encode(message: Message) -> bytes:
    """The bytes that are sent (MessagePack)."""
    return _encoder.encode(message)


def decode(data: bytes, limit: int = MAX_BYTES) -> Message:
    """The message in these bytes.

    Raises
    ------
    InvalidMessage
        Too large (seen before anything is parsed), not MessagePack, unknown tag, bad field, wrong checksum.
    """
    message = _guarded(_decoder, data, limit)
    if isinstance(message, Window):
        _require(message.crc == checksum(message.channels), "window checksum does not match its channels")
    return message


def encode_json(message: ParameterMessage) -> bytes:
    """A parameter message as JSON."""
    return _json_encoder.encode(message)


def decode_json(data: bytes, limit: int = MAX_BYTES) -> ParameterMessage:
    """The parameter message in this JSON text; raises InvalidMessage as `decode` does."""
    return _guarded(_json_decoder, data, limit)


def checksum(channels: Iterable[Channel]) -> int:
    """CRC-32 over names, units, scales, offsets and samples."""
    crc = 0
    for channel in channels:
        head = pack("<dd", channel.scale, channel.offset) + f"{channel.name}\0{channel.unit}\0".encode()
        crc = crc32(channel.data, crc32(head, crc))
    return crc


def pack_channel(name: str, unit: str, samples: Iterable[float]) -> Channel:
    """Quantise samples to int16 with the scale and offset that use the whole range.

    The reconstruction is within scale / 2 = (max - min) / 131070 of each sample (and rounding); a constant is exact.

    Raises
    ------
    InvalidMessage
        No samples, or a sample that is not finite.
    """
    values = samples if isinstance(samples, array) else array("d", samples)
    _require(len(values) > 0, f"channel {name}: no samples")
    if not _all_finite(values):
        index = next(k for k, value in enumerate(values) if not isfinite(value))
        raise InvalidMessage(f"channel {name}: sample {index} is {values[index]} {unit}, not finite")
    lowest, highest = min(values), max(values)
    scale = (highest - lowest) / _STEPS
    _require(isfinite(scale), f"channel {name}: the range from {lowest} to {highest} {unit} is too large")
    if scale == 0.0:
        return Channel(name, unit, 0.0, lowest, bytes(2 * len(values)))
    codes = array("h", [_code((value - lowest) / scale) for value in values])
    return Channel(name, unit, scale, lowest - _LOWEST * scale, _little_endian(codes).tobytes())


def pack_finely(name: str, unit: str, samples: Iterable[float]) -> tuple[Channel, Channel]:
    """The channel as `pack_channel` packs it, and what the rounding left as a second one, `name` + `FINE`.

    Who does not know the second one loses what the rounding always lost.
    """
    values = samples if isinstance(samples, array) else array("d", samples)
    coarse = pack_channel(name, unit, values)
    rest = array("d", [value - rounded for value, rounded in zip(values, unpack_channel(coarse), strict=True)])
    return coarse, pack_channel(name + FINE, unit, rest)


def unpack_channel(channel: Channel) -> "array[float]":
    """The samples, in the channel's unit."""
    codes = array("h")
    codes.frombytes(channel.data)
    scale, offset = channel.scale, channel.offset
    return array("d", [offset + scale * code for code in _little_endian(codes)])


def finite(value: float) -> float | None:
    """`value`, or None (unknown, unbounded) when it is not finite: how estimates are written into an update."""
    return value if isfinite(value) else None


def _code(steps: float) -> int:
    return min(round(steps), _STEPS) + _LOWEST


def _little_endian(codes: "array[int]") -> "array[int]":
    if sys.byteorder == "big":
        codes.byteswap()
    return codes


def _all_finite(values: Iterable[float]) -> bool:
    return all(map(isfinite, values))


def _require(condition: bool, otherwise: str) -> None:
    if not condition:
        raise InvalidMessage(otherwise)


def _guarded(
    decoder: "msgspec.msgpack.Decoder[_Decoded] | msgspec.json.Decoder[_Decoded]", data: bytes, limit: int
) -> _Decoded:
    """Decode, with every way in which bytes can be wrong turned into InvalidMessage."""
    _require(len(data) <= limit, f"message of {len(data)} bytes: at most {limit} are allowed")
    try:
        return decoder.decode(data)
    except InvalidMessage:
        raise
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
        raise InvalidMessage(f"message not understood: {error}") from None
