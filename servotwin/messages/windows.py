"""Windows and hellos, to the twin; acknowledgements, back."""

from math import isfinite
from typing import Annotated

from msgspec import Meta, Struct

from servotwin.messages.channels import Channel
from servotwin.messages.checks import Count, Name, Text, all_finite, require
from servotwin.messages.setting import Setting


class WindowMessage(Struct, frozen=True, tag="window/1"):
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
    """

    servo: Name
    boot: Name
    time: float
    rate: float
    parameter_version: Count
    setting: Setting
    model_version: Text

    def __post_init__(self) -> None:
        require(
            all_finite((self.time, self.rate, self.setting.tolerance)), "hello time, rate and tolerance must be finite"
        )


class Acknowledge(Struct, frozen=True, tag="ack/1"):
    """Acknowledgement of a window that the twin has stored; the edge may delete it."""

    servo: Name
    boot: Name
    sequence: Count
