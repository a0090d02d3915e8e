"""Requests to the edge, for more informative windows or for windows that the twin misses; answers, back."""

from enum import StrEnum
from math import isfinite
from typing import Annotated

from msgspec import Meta, Struct

from servotwin.messages.checks import Count, Name, Reported, Text, require

PROBE, TEACHING = "probe", "teaching"
"""Reasons of the windows of a probing move: there and back, and to several places, in moves of different lengths."""
_MAX_SECONDS = 600.0
"""Longest window or probe that a request may name, s; an edge's own limits are tighter."""
THERE_AND_BACK = (1.0, 0.0)
"""Places of a move to its size and back, as shares of the size."""


class LongerWindow(Struct, frozen=True, tag="window"):
    """Request for longer windows, from the next change of the reference on.

    Attributes
    ----------
    window_s, pre_trigger_s : float
        Length of a window, and the part of it before the change, s.
    """

    window_s: float
    pre_trigger_s: float

    def __post_init__(self) -> None:
        require(0.0 < self.window_s <= _MAX_SECONDS, f"request window_s {self.window_s} s is not allowed")
        require(
            0.0 <= self.pre_trigger_s < self.window_s, f"request pre_trigger_s {self.pre_trigger_s} s is not allowed"
        )


class Probe(Struct, frozen=True, omit_defaults=True, tag="probe"):
    """Request for one probing move of the reference, to places near it and back, while it rests.

    An edge that knows no `places` moves there and back.

    Attributes
    ----------
    size : float
        m, largest offset that is added to the reference.
    hold_s : float
        s at each place; those after the last return are for observation.
    strokes : int
        Number of times that the places are visited.
    places : tuple of float
        Offsets in their order, as shares of the size; the last one is 0.
    """

    size: float
    hold_s: float
    strokes: Annotated[int, Meta(ge=1, le=16)] = 1
    places: Annotated[tuple[Annotated[float, Meta(ge=-1.0, le=1.0)], ...], Meta(min_length=2, max_length=16)] = (
        THERE_AND_BACK
    )

    def __post_init__(self) -> None:
        require(isfinite(self.size) and self.size != 0.0, f"request size {self.size} m is not allowed")
        require(self.places[-1] == 0.0, f"request places end at {self.places[-1]}: must end at 0")
        require(isfinite(self.hold_s) and self.hold_s > 0.0, f"request hold_s {self.hold_s} s is not allowed")
        require(self.duration <= _MAX_SECONDS, f"request takes {self.duration} s: at most {_MAX_SECONDS} s are allowed")

    @property
    def duration(self) -> float:
        """s, from the first move to the end of the last hold."""
        return len(self.places) * self.strokes * self.hold_s

    @property
    def teaches(self) -> bool:
        """True where its moves differ in length: they tell the transmission's ratio too."""
        return self.places != THERE_AND_BACK

    @property
    def window_reason(self) -> str:
        """Reason of its window."""
        return TEACHING if self.teaches else PROBE


Ask = LongerWindow | Probe


class Request(Struct, frozen=True, tag="request/1"):
    """Request for windows that show the gap better.

    Attributes
    ----------
    boot : str
        Boot of the edge for which the request was made.
    serial : int
        Number of the request; rises within a boot of the edge.
    ask : LongerWindow or Probe
    not_after : float
        Sample time of the edge, s, from which on the request must not be started.
    reason : str
        Reason in words.
    """

    servo: Name
    boot: Name
    serial: Annotated[int, Meta(ge=1, le=2**53)]
    ask: Ask
    not_after: float
    reason: Text = ""

    def __post_init__(self) -> None:
        require(isfinite(self.not_after), f"request not_after {self.not_after} s is not finite")


class RequestOutcome(StrEnum):
    """Decision of the edge about a request."""

    ACCEPTED = "taken"  # the word on the wire
    WRONG_SERVO = "wrong servo"
    OTHER_BOOT = "made for another boot"
    DUPLICATE = "a request of this serial or a later one was decided already"
    EXPIRED = "expired"
    NOT_ALLOWED = "not allowed at this edge"
    TOO_LARGE = "larger than allowed at this edge"
    TOO_SOON = "too soon after the last probe"
    BUSY = "the reference does not rest, or a window is being recorded"

    @property
    def temporary(self) -> bool:
        """True where the same request may be accepted later."""
        return self in (RequestOutcome.BUSY, RequestOutcome.TOO_SOON)


class Answer(Struct, frozen=True, tag="answer/1"):
    """Answer of the edge to a request.

    Attributes
    ----------
    serial : int
        The request's.
    sample : int
        First sample at which the request is in effect, or at which it was refused.
    outcome : RequestOutcome
    newest : int
        Highest serial decided so far: a twin that lost its state continues from there.
    """

    servo: Name
    boot: Name
    serial: Count
    sample: Count
    outcome: RequestOutcome
    newest: Reported

    @property
    def accepted(self) -> bool:
        """True where the edge does what was requested."""
        return self.outcome is RequestOutcome.ACCEPTED


class Resend(Struct, frozen=True, omit_defaults=True, tag="resend/1"):
    """Request for windows that the twin misses: its store was restored from a backup, or lost them.

    An edge keeps windows for a while after they were acknowledged. It sends those that are asked for once more, in the
    ordinary way, and ignores the rest. Asked for windows of every boot, it sends a hello too, so that the twin knows
    which boot is the current one. The twin stores each window once, whatever it asks for.

    Attributes
    ----------
    boot : str or None
        Boot of the windows; None: every boot.
    first, last : int, int or None
        Sequences, both included; None: to the newest.
    reason : str
        Reason in words.
    """

    servo: Name
    boot: Name | None = None
    first: Count = 0
    last: Count | None = None
    reason: Text = ""

    def __post_init__(self) -> None:
        require(self.last is None or self.first <= self.last, f"resend first {self.first} is after last {self.last}")

    def asks_for(self, boot: str, sequence: int) -> bool:
        """True where a window is among those that the twin misses."""
        in_range = self.first <= sequence and (self.last is None or sequence <= self.last)
        return in_range and self.boot in (None, boot)
