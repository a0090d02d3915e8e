"""What carries an edge's messages to the twin and the twin's back: the protocol, what can go wrong, how long to wait.

A transport knows bytes only. It may lose, delay and repeat; it says "delivered" only when the twin has said so.
"""

import zlib
from dataclasses import dataclass
from math import inf
from typing import NamedTuple, Protocol

from servotwin.errors import InvalidInput
from servotwin.messages import Refusal

DEFLATE = "deflate"


def squeezed(body: bytes) -> tuple[bytes, str]:
    """The body and its encoding: deflated where that makes it smaller."""
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
        """Whether it is a window; otherwise it is a letter."""
        return self.boot != ""


class Unreachable(Exception):
    """The twin was not reached, or what answered is not the twin: whatever was to be sent is kept."""


class Refused(Exception):
    """The twin does not take a message.

    Attributes
    ----------
    reason : Refusal
        `reason.passing` tells whether the message is kept.
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


@dataclass(slots=True)
class Backoff:
    """Pauses that grow from one failure to the next, each somewhere between half and the whole of its length.

    Parameters
    ----------
    first_s, factor, longest_s : float
        As `link.session.Retry` names them.
    failures : int
        In a row, so far.
    """

    first_s: float = 1.0
    factor: float = 2.0
    longest_s: float = 60.0
    failures: int = 0

    def __post_init__(self) -> None:
        if not (0.0 < self.first_s <= self.longest_s < inf and 1.0 <= self.factor < inf):
            raise InvalidInput(f"pauses from {self.first_s!r} s to {self.longest_s!r} s: must be positive and in order")

    def failed(self, chance: float) -> float:
        """s to wait after a failure; `chance` is uniform in 0 .. 1, so that edges do not come back all at once."""
        pause = self.first_s
        for _ in range(min(self.failures, 64)):
            pause = min(pause * self.factor, self.longest_s)
        self.failures += 1
        return pause * (0.5 + 0.5 * chance)

    def succeeded(self) -> None:
        """The next failure is the first one again."""
        self.failures = 0
