"""Transport of an edge's messages to the twin and back: the protocol, and its errors.

A transport knows bytes only. It may lose, delay and repeat; it says "delivered" only when the twin has said so.
"""

import zlib
from typing import NamedTuple, Protocol

from servotwin.messages import Refusal

DEFLATE = "deflate"


def deflated(body: bytes) -> tuple[bytes, str]:
    """Deflate the body where that makes it smaller; return it and its encoding."""
    smaller = zlib.compress(body, 1)
    return (smaller, DEFLATE) if len(smaller) < len(body) else (body, "")


class Parcel(NamedTuple):
    """One message to the twin.

    Attributes
    ----------
    servo : str
    body : bytes
        The encoded message, by `encoding`.
    encoding : str
        "" or "deflate".
    boot, sequence : str, int
        Of a window; a letter (hello, receipt, fallback, answer) has no boot.
    """

    servo: str
    body: bytes
    encoding: str = ""
    boot: str = ""
    sequence: int = 0

    @property
    def is_window(self) -> bool:
        """It is a window; otherwise it is a letter."""
        return self.boot != ""


class Unreachable(Exception):
    """The twin was not reached, or what answered is not the twin: whatever was to be sent is kept."""


class Refused(Exception):
    """The twin does not take a message.

    Attributes
    ----------
    reason : Refusal
        `reason.temporary` tells whether the message is kept.
    detail : str
        One sentence.
    after_s : float
        It asks not to be sent anything before that time has gone by, s.
    """

    def __init__(self, reason: Refusal, detail: str, after_s: float = 0.0) -> None:
        super().__init__(f"{reason.value}: {detail}")
        self.reason, self.detail, self.after_s = reason, detail, after_s


class Transport(Protocol):
    """Carries one servo's messages. `deliver` and `listen` are called from a thread each."""

    def deliver(self, parcel: Parcel) -> None:
        """Return when the twin has the message safe, now or from before.

        Raises
        ------
        Refused
        Unreachable
            Whether the twin has it is not known.
        """

    def listen(self, after: int) -> list[bytes]:
        """Sealed messages of the twin with serials above `after`, rising; waits a while for the first one.

        What was returned is returned again until `after` is past it.

        Raises
        ------
        Refused
        Unreachable
        """

    def close(self) -> None:
        """Let go of connections, at once; `deliver` and `listen` under way raise `Unreachable`."""
