"""Frames between the control process and the link process.

A frame that must not be lost carries a serial. The control process stores it until the link process has its content on
disk and sends an `AckFrame`; so either process may be killed at any time.
"""

from __future__ import annotations

from array import array

import msgspec
from msgspec import Struct

from servotwin.edge.recorder import Cut
from servotwin.edge.store import StoredParameters
from servotwin.messages import InvalidMessage

Value = float | int | str | bool | None


class WindowFrame(Struct, frozen=True, array_like=True, tag="window"):
    """A cut window, raw: doubles in this machine's byte order."""

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
        """The cut that the frame carries."""
        signals = {name: _doubles(data) for name, data in self.signals.items()}
        return Cut(
            first=self.first,
            sequence=self.sequence,
            reason=self.reason,
            parameter_version=self.parameter_version,
            before=self.before,
            signals=signals,
            gap=self.gap,
            basis=self.basis,
        )


class LetterFrame(Struct, frozen=True, array_like=True, tag="letter"):
    """An encoded hello, receipt, fallback or answer."""

    serial: int
    body: bytes


class ResponseFrame(Struct, frozen=True, array_like=True, tag="response"):
    """An encoded learnt response for the window filter, from the windows after it on."""

    serial: int
    boot: str
    body: bytes


class SaveFrame(Struct, frozen=True, array_like=True, tag="save"):
    """Parameters under which the loop kept its band, to be stored on disk."""

    serial: int
    parameters: StoredParameters


class ProcessedFrame(Struct, frozen=True, array_like=True, tag="processed"):
    """The agent has processed the twin's message of this serial."""

    serial: int


class StatusFrame(Struct, frozen=True, array_like=True, tag="status"):
    """Status of the control process, about once a second; `ticks` is a histogram of tick times by microseconds."""

    boot: str
    samples: int
    values: dict[str, Value]
    dropped: dict[str, int]
    ticks: bytes


class AckFrame(Struct, frozen=True, array_like=True, tag="ack"):
    """Acknowledgement: the link process need not be sent the frame of this serial again."""

    serial: int


class MessageFrame(Struct, frozen=True, array_like=True, tag="message"):
    """A message for the agent; serial 0: an acknowledgement of a window, which has no serial of the twin's."""

    serial: int
    body: bytes


class PendingFrame(Struct, frozen=True, array_like=True, tag="pending"):
    """Number of windows that wait for the twin's acknowledgement, and numbers of windows dropped, by reason."""

    pending: int
    dropped: dict[str, int]


class ReconnectedFrame(Struct, frozen=True, array_like=True, tag="reconnected"):
    """The twin is reached again."""


class SupersededFrame(Struct, frozen=True, array_like=True, tag="superseded"):
    """Another edge of the servo has taken over: nothing is sent any more."""


ToLink = WindowFrame | LetterFrame | ResponseFrame | SaveFrame | ProcessedFrame | StatusFrame
ToControl = AckFrame | MessageFrame | PendingFrame | ReconnectedFrame | SupersededFrame

encode = msgspec.msgpack.Encoder().encode
_to_link: msgspec.msgpack.Decoder[ToLink] = msgspec.msgpack.Decoder(ToLink)
_to_control: msgspec.msgpack.Decoder[ToControl] = msgspec.msgpack.Decoder(ToControl)


def to_link(data: bytes) -> ToLink:
    """Decode a frame for the link process; raises InvalidMessage."""
    try:
        return _to_link.decode(data)
    except (msgspec.MsgspecError, ValueError) as error:
        raise InvalidMessage(f"frame not understood: {error}") from None


def to_control(data: bytes) -> ToControl:
    """Decode a frame for the control process; raises InvalidMessage."""
    try:
        return _to_control.decode(data)
    except (msgspec.MsgspecError, ValueError) as error:
        raise InvalidMessage(f"frame not understood: {error}") from None


def window_frame(cut: Cut, boot: str, serial: int) -> WindowFrame:
    """Make the frame that carries a cut."""
    signals = {name: values.tobytes() for name, values in cut.signals.items()}
    return WindowFrame(
        serial=serial,
        boot=boot,
        first=cut.first,
        sequence=cut.sequence,
        reason=cut.reason,
        parameter_version=cut.parameter_version,
        before=cut.before,
        signals=signals,
        gap=cut.gap,
        basis=cut.basis,
    )


def _doubles(data: bytes) -> array[float]:
    values = array("d")
    values.frombytes(data)
    return values
