"""One recorded signal as int16 with a scale and an offset."""

import sys
from array import array
from collections.abc import Iterable
from math import isfinite
from struct import pack
from zlib import crc32

from msgspec import Struct

from servotwin.messages.checks import InvalidMessage, Name, Text, all_finite, require

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
        require(isfinite(self.scale) and self.scale >= 0.0, f"channel {self.name}: scale {self.scale} is not allowed")
        require(isfinite(self.offset), f"channel {self.name}: offset {self.offset} is not finite")
        require(len(self.data) > 0 and len(self.data) % 2 == 0, f"channel {self.name}: not a number of int16 samples")

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
    codes = array("h", [_code((value - lowest) / scale) for value in values])
    return Channel(name, unit, scale, lowest - _LOWEST * scale, _little_endian(codes).tobytes())


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


def _code(steps: float) -> int:
    # A scale near the smallest float is so coarse that the quotient can exceed the last step.
    return min(round(steps), _STEPS) + _LOWEST


def _little_endian(codes: "array[int]") -> "array[int]":
    if sys.byteorder == "big":
        codes.byteswap()
    return codes
