"""The edge's listening: what the twin says is checked, and told once and in order."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from servotwin.link.seal import TO_EDGE, Sealed, key_of, opened, verifier_of
from servotwin.link.transport import Refused, Transport, Unreachable
from servotwin.messages import MAX_BYTES, Acknowledge, InvalidMessage, Request, Update, decode
from servotwin.runtime.retry import Backoff, Retry


class Told(NamedTuple):
    """What a poll brought.

    Attributes
    ----------
    wait_s : float
        How long to wait before the next one.
    messages : list of (int, bytes)
        Serial and encoded message, rising.
    """

    wait_s: float
    messages: list[tuple[int, bytes]]


@dataclass(slots=True)
class Listener:
    """Polls a transport; one step is one poll.

    Parameters
    ----------
    transport : Transport
    servo, token : str
    after : int
        Serial of the last message that was handled.
    retry : Retry
    chance : callable
        Uniform in 0 .. 1.
    counts : Counter
        Messages heard, tries that failed, what was not let through and why.
    """

    transport: Transport
    servo: str
    token: str = field(repr=False)
    after: int
    retry: Retry
    chance: Callable[[], float]
    counts: Counter[str] = field(default_factory=Counter)
    trouble: str = ""
    _pauses: Backoff = field(init=False)

    def __post_init__(self) -> None:
        self._pauses = Backoff(self.retry)

    def step(self) -> Told:
        """One poll; waits as long as the transport does."""
        try:
            came = self.transport.listen(self.after)
        except Unreachable as error:
            return self._pause("unreachable", str(error), 0.0)
        except Refused as error:
            return self._pause(f"refused: {error.reason.value}", str(error), error.after_s)
        messages = [message for message in map(self._checked, came) if message is not None]
        if came and not messages:  # or the same would come again at once, for ever
            return self._pause("nothing new", "what the twin says is not let through", 0.0)
        self._pauses.succeeded()
        self.trouble = ""
        return Told(0.0, messages)

    def _checked(self, data: bytes) -> tuple[int, bytes] | None:
        """A message whose seal is whole, that is new, and that an edge takes."""
        try:
            sealed = opened(key_of(verifier_of(self.token)), TO_EDGE, self.servo, data, MAX_BYTES)
        except InvalidMessage:
            self.counts["broken seal"] += 1
            return None
        if sealed.serial <= self.after:
            self.counts["repeated"] += 1
            return None
        self.after = sealed.serial
        return self._understood(sealed)

    def _understood(self, sealed: Sealed) -> tuple[int, bytes] | None:
        try:
            good = isinstance(decode(sealed.body), Update | Request | Acknowledge)
        except InvalidMessage:
            good = False
        self.counts["heard" if good else "not understood"] += 1
        return (sealed.serial, sealed.body) if good else None

    def _pause(self, what: str, trouble: str, after_s: float) -> Told:
        self.counts[what] += 1
        self.trouble = trouble
        return Told(max(after_s, self._pauses.failed(self.chance())), [])
