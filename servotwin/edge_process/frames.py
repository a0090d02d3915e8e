"""What the control process and the link process say to each other.

Whatever must not be lost carries a serial and is kept by the control process until the link process has it on disk
(`Done`), so that either may be killed at any time.
"""

from __future__ import annotations

from array import array

import msgspec
from msgspec import Struct

from servotwin.edge.cut import Cut
from servotwin.edge.store import StoredParameters
from servotwin.messages import InvalidMessage

Value = float | int | str | bool | None


class CutFrame(Struct, frozen=True, array_like=True, tag="cut"):
    """A cut window, raw: doubles as this machine has them."""

    serial: int
    boot: str
    first: int
    sequence: int
    reason: str
    parameter_version: int
    before: float
    signals: dict[str, bytes]
    gap: float | None
    basis: int | None

    @property
    def cut(self) -> Cut:
        """The cut."""
        signals = {name: _doubles(data) for name, data in self.signals.items()}
        names = (self.first, self.sequence, self.reason, self.parameter_version, self.before)
        return Cut(*names, signals, self.gap, self.basis)


class LetterFrame(Struct, frozen=True, array_like=True, tag="letter"):
    """An encoded hello, receipt, fallback or answer."""

    serial: int
    body: bytes


class SaveFrame(Struct, frozen=True, array_like=True, tag="save"):
    """Parameters that were proved at the machine: to be kept on disk."""

    serial: int
    parameters: StoredParameters


class HandledFrame(Struct, frozen=True, array_like=True, tag="handled"):
    """The twin's message of this serial was handled."""

    serial: int


class TicksFrame(Struct, frozen=True, array_like=True, tag="ticks"):
    """What the control process says of itself, about once a second: `ticks` are counts by microseconds."""

    boot: str
    samples: int
    values: dict[str, Value]
    dropped: dict[str, int]
    ticks: bytes


class DoneFrame(Struct, frozen=True, array_like=True, tag="done"):
    """The link process has taken what carried this serial."""

    serial: int


class HeardFrame(Struct, frozen=True, array_like=True, tag="heard"):
    """A message for the agent; serial 0: an acknowledgement, not counted among the twin's."""

    serial: int
    body: bytes


class StandingFrame(Struct, frozen=True, array_like=True, tag="standing"):
    """Windows that wait for the twin's acknowledgement, and those given up, by reason."""

    waiting: int
    dropped: dict[str, int]


class BackFrame(Struct, frozen=True, array_like=True, tag="back"):
    """The twin is reached again."""


ToLink = CutFrame | LetterFrame | SaveFrame | HandledFrame | TicksFrame
ToControl = DoneFrame | HeardFrame | StandingFrame | BackFrame

encode = msgspec.msgpack.Encoder().encode
_to_link: msgspec.msgpack.Decoder[ToLink] = msgspec.msgpack.Decoder(ToLink)
_to_control: msgspec.msgpack.Decoder[ToControl] = msgspec.msgpack.Decoder(ToControl)


def to_link(data: bytes) -> ToLink:
    """A frame for the link process; raises InvalidMessage."""
    try:
        return _to_link.decode(data)
    except (msgspec.MsgspecError, ValueError) as error:
        raise InvalidMessage(f"frame not understood: {error}") from None


def to_control(data: bytes) -> ToControl:
    """A frame for the control process; raises InvalidMessage."""
    try:
        return _to_control.decode(data)
    except (msgspec.MsgspecError, ValueError) as error:
        raise InvalidMessage(f"frame not understood: {error}") from None


def framed(cut: Cut, boot: str, serial: int) -> CutFrame:
    """A cut as it crosses."""
    signals = {name: values.tobytes() for name, values in cut.signals.items()}
    names = (cut.first, cut.sequence, cut.reason, cut.parameter_version, cut.before)
    return CutFrame(serial, boot, *names, signals, cut.gap, cut.basis)


def _doubles(data: bytes) -> array[float]:
    values = array("d")
    values.frombytes(data)
    return values
