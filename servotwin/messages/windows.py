"""Windows, their int16 channels and hellos, to the twin; acknowledgements, back."""

import sys
from array import array
from collections.abc import Iterable
from math import isfinite
from struct import pack
from typing import Annotated
from zlib import crc32

from msgspec import Meta, Struct

from servotwin.messages.checks import Count, InvalidMessage, Name, Reported, Text, all_finite, require
from servotwin.messages.setting import Setting

FINE = "_fine"
"""Suffix of a channel that holds the rounding errors of another one."""
_LOWEST, _STEPS = -32768, 65535


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
        # Not `require`: the sentences would be made for every channel of every window.
        if not (isfinite(self.scale) and self.scale >= 0.0):
            raise InvalidMessage(f"channel {self.name}: scale {self.scale} is not allowed")
        if not isfinite(self.offset):
            raise InvalidMessage(f"channel {self.name}: offset {self.offset} is not finite")
        if not self.data or len(self.data) % 2:
            raise InvalidMessage(f"channel {self.name}: not a number of int16 samples")

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.data) // 2


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
    require(len(values) > 0, f"channel {name}: no samples")
    if not all_finite(values):
        index = next(k for k, value in enumerate(values) if not isfinite(value))
        raise InvalidMessage(f"channel {name}: sample {index} is {values[index]} {unit}, not finite")
    lowest, highest = min(values), max(values)
    scale = (highest - lowest) / _STEPS
    require(isfinite(scale), f"channel {name}: the range from {lowest} to {highest} {unit} is too large")
    if scale == 0.0:
        return Channel(name, unit, 0.0, lowest, bytes(2 * len(values)))
    codes = [round((value - lowest) / scale) + _LOWEST for value in values]
    most = _STEPS + _LOWEST
    # A scale near the smallest float is so coarse that the quotient can exceed the last step.
    if max(codes) > most:
        codes = [min(code, most) for code in codes]
    return Channel(name, unit, scale, lowest - _LOWEST * scale, _little_endian(array("h", codes)).tobytes())


def pack_finely(name: str, unit: str, samples: Iterable[float]) -> tuple[Channel, Channel]:
    """Pack a channel as `pack_channel` does, and its rounding errors as a second one, `name` + `FINE`.

    A reader that ignores the second one has the usual resolution.
    """
    values = samples if isinstance(samples, array) else array("d", samples)
    coarse = pack_channel(name, unit, values)
    rest = array("d", [value - rounded for value, rounded in zip(values, unpack_channel(coarse), strict=True)])
    return coarse, pack_channel(name + FINE, unit, rest)


def unpack_channel(channel: Channel) -> "array[float]":
    """Return the samples in the channel's unit."""
    codes = array("h")
    codes.frombytes(channel.data)
    scale, offset = channel.scale, channel.offset
    return array("d", [offset + scale * code for code in _little_endian(codes)])


def _little_endian(codes: "array[int]") -> "array[int]":
    if sys.byteorder == "big":
        codes.byteswap()
    return codes


class WindowMessage(Struct, frozen=True, omit_defaults=True, tag="window/1"):
    """Recorded samples, identified by (servo, boot, sequence).

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
        Version of the servo's model on the edge; reason for sending the window.
    crc : int
        `checksum(channels)`.
    response_version : int or None
        Version of the learnt response that the edge's window filter used, 0: the configured one; None: it takes none.
    """

    servo: Name
    boot: Name
    sequence: Count
    start: float
    rate: float
    channels: Annotated[tuple[Channel, ...], Meta(min_length=1, max_length=32)]
    reference_changes: Annotated[tuple[tuple[float, float], ...], Meta(max_length=4096)]
    parameter_version: Reported
    model_version: Text
    reason: Text
    crc: Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]
    response_version: Count | None = None

    def __post_init__(self) -> None:
        require(isfinite(self.start), f"window start {self.start} s is not finite")
        require(isfinite(self.rate) and self.rate > 0.0, f"window rate {self.rate} Hz is not positive")
        require(all_finite(x for change in self.reference_changes for x in change), "a reference change is not finite")
        require(len({c.samples for c in self.channels}) == 1, "window channels differ in length")
        require(len({c.name for c in self.channels}) == len(self.channels), "window channel names repeat")
        require(isfinite(self.start + self.samples / self.rate), "the time of the window's last sample is not finite")

    @property
    def identity(self) -> tuple[str, str, int]:
        """(servo, boot, sequence), unique for ever."""
        return self.servo, self.boot, self.sequence

    @property
    def samples(self) -> int:
        """Samples per channel."""
        return self.channels[0].samples

    @property
    def middle(self) -> float:
        """Sample time half-way between the first and the last sample, s."""
        return self.start + 0.5 * (self.samples - 1) / self.rate

    def channel(self, name: str) -> Channel | None:
        """The channel of that name, if it was recorded."""
        return next((channel for channel in self.channels if channel.name == name), None)


class Hello(Struct, frozen=True, tag="hello/2"):
    """Introduction of an edge after a start or a reconnection.

    Attributes
    ----------
    time : float
        Its sample time, s.
    rate : float
        Hz.
    parameter_version : int
        In force.
    setting : Setting
        Setting in force; after a restart, the last one under which the loop stayed in its band. Gains None: updates set
        none at this edge.
    model_version : str
        Version of the servo's model on the edge.
    protocol : int
        Version of the edge's protocol; 1 where it does not tell.
    """

    servo: Name
    boot: Name
    time: float
    rate: float
    parameter_version: Reported
    setting: Setting
    model_version: Text
    protocol: Count = 1

    def __post_init__(self) -> None:
        require(isfinite(self.time), f"hello time {self.time} s is not finite")
        require(isfinite(self.rate) and self.rate > 0.0, f"hello rate {self.rate} Hz is not positive")
        require(self.setting.has_valid_tolerance(), f"hello tolerance {self.setting.tolerance} m is not allowed")


class Acknowledge(Struct, frozen=True, tag="ack/1"):
    """Acknowledgement of a window that the twin has stored; the edge may delete it."""

    servo: Name
    boot: Name
    sequence: Count


class LetterAcknowledge(Struct, frozen=True, tag="letter-ack/1"):
    """Acknowledgement of a letter, by the digest of its bytes, over a link whose requests have no responses."""

    servo: Name
    digest: Annotated[bytes, Meta(min_length=16, max_length=16)]
