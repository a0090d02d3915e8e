"""Transport of an edge's messages to the twin and back: the protocol, and its errors.

A transport carries bytes. It may lose, delay and repeat them; `deliver` returns only after the twin's own
acknowledgement.
"""

from typing import NamedTuple, Protocol

from servotwin.messages import Refusal


class Parcel(NamedTuple):
    """One message to the twin.

    Attributes
    ----------
    servo : str
    body : bytes
        Encoded message, compressed as `encoding` says.
    encoding : str
        "" or "deflate".
    boot, sequence : str, int
        Key of a window; a letter (hello, receipt, fallback, answer) has no boot.
    waiting : int
        Number of windows that the edge has to send beside this one, for the twin's pace.
    """

    servo: str
    body: bytes
    encoding: str = ""
    boot: str = ""
    sequence: int = 0
    waiting: int = 0

    @property
    def is_window(self) -> bool:
        """True for a window, False for a letter."""
        return self.boot != ""


LONGEST_OLDER_PAUSE_S = 60.0
"""Longest pause before an older window to which an edge agrees, s."""


class Unreachable(Exception):
    """The twin was not reached, or something else answered in its place: the message stays in the outbox."""


class Refused(Exception):
    """The twin refuses a message.

    Attributes
    ----------
    reason : Refusal
        `reason.temporary` is True where the message stays in the outbox.
    detail : str
        One sentence.
    after_s : float
        Time for which the twin asks not to be sent anything, s.
    """

    def __init__(self, reason: Refusal, detail: str, after_s: float = 0.0) -> None:
        super().__init__(f"{reason.value}: {detail}")
        self.reason, self.detail, self.after_s = reason, detail, after_s


class Transport(Protocol):
    """Carries one servo's messages. `deliver` and `listen` are called from a thread each."""

    def deliver(self, parcel: Parcel) -> float:
        """Send a message; return when the twin has committed it, now or earlier.

        Returns the pause that the twin asks for before each window that a newer one has overtaken, s; 0: none.

        Raises
        ------
        Refused
        Unreachable
            It is not known whether the twin has it.
        """

    def listen(self, after: int, at_once: bool = False) -> list[bytes]:
        """Return the twin's sealed messages with serials above `after`, in rising order; wait for the first one.

        With `at_once` it does not wait: the answer shows that the twin is there. A message is returned again by each
        call until `after` has reached its serial.

        Raises
        ------
        Refused
        Unreachable
        """

    def listen_anew(self) -> None:
        """End a `listen` under way that may wait for nothing: it began before the twin was out of reach for a time."""

    def close(self) -> None:
        """Close the connections at once; `deliver` and `listen` under way raise `Unreachable`."""
