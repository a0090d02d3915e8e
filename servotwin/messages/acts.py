"""Acts of an engineer on the twin of one machine. They never travel to an edge, and none may come from one."""

from enum import StrEnum
from math import isfinite

import msgspec
from msgspec import Struct

from servotwin.messages.checks import Count, InvalidMessage, Name, Text, require

MAX_ACT_BYTES = 4096


class ActKind(StrEnum):
    """Kind of an act.

    hold: send no new version until the release; roll back: hold, and send an earlier setting as a new version; ask
    first: let each new version wait until it is approved; ask no more: send it at once, as before.
    """

    HOLD = "hold"
    RELEASE = "release"
    ROLL_BACK = "roll back"
    ASK_FIRST = "ask first"
    ASK_NO_MORE = "ask no more"
    APPROVE = "approve"


class Act(Struct, frozen=True, omit_defaults=True, tag="act/1"):
    """An engineer's act.

    Attributes
    ----------
    servo : str
    act : ActKind
    who : str
        The engineer's name.
    why : str
        The reason, which is not empty.
    time : float
        s since the epoch.
    version : int, optional
        Of a roll back: the version whose setting is sent again; None: the fallback set.
    window : (str, int), optional
        Of an approval: boot and sequence of the window that the proposal is based on.
    """

    servo: Name
    act: ActKind
    who: Name
    why: Text
    time: float
    version: Count | None = None
    window: tuple[Name, Count] | None = None

    def __post_init__(self) -> None:
        require(bool(self.why.strip()) and self.why.isprintable(), "why: give a reason, on one line")
        require(isfinite(self.time), f"act time {self.time} s is not finite")
        require(
            (self.window is not None) == (self.act is ActKind.APPROVE), "window: an approval, and only that, names one"
        )
        require(self.version is None or self.act is ActKind.ROLL_BACK, "version: only a roll back names one")

    @property
    def sentence(self) -> str:
        """The act in words, with the engineer and the reason."""
        done = {ActKind.HOLD: "held", ActKind.ROLL_BACK: "rolled back", ActKind.RELEASE: "released"}
        return f"{done.get(self.act, self.act.value)} by {self.who}: {self.why}"


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Act)


def encode_act(act: Act) -> bytes:
    """Encode an act for the store."""
    return _encoder.encode(act)


def decode_act(data: bytes) -> Act:
    """Decode an act from the store; raises InvalidMessage."""
    try:
        return _decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InvalidMessage(f"act not understood: {error}") from None
