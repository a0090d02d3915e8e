"""The edge's half of the link over a transport with responses: one step sends one message, or polls once."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple

from servotwin.link.outbox import Key
from servotwin.link.seal import TO_EDGE, Sealed, key_of, opened, verifier_of
from servotwin.link.session import Session
from servotwin.link.transport import Refused, Transport, Unreachable
from servotwin.messages import MAX_BYTES, Acknowledge, InvalidMessage, Request, Update, decode
from servotwin.runtime.retry import Backoff, Retry


class Sent(NamedTuple):
    """Result of a sender's step.

    Attributes
    ----------
    wait_s : float
        Time until something is due; inf: nothing is due until something is put into the outbox.
    window : Key, optional
        Window that the twin has acknowledged in this step.
    reconnected : bool
        The twin is reached again after it was out of reach.
    """

    wait_s: float = 0.0
    window: Key | None = None
    reconnected: bool = False


@dataclass(slots=True)
class Sender:
    """Delivers the messages that are due in a session.

    Parameters
    ----------
    session : Session
    transport : Transport
    """

    session: Session
    transport: Transport

    def step(self, now: float) -> Sent:
        """Deliver the message that is due, if one is."""
        session = self.session
        item = next(session.due(now), None)
        if item is None:
            due = session.next_time
            return Sent(inf if due is None else due - now)
        try:
            outbox = session.outbox
            self.transport.deliver(outbox.letter(item) if isinstance(item, bytes) else outbox.parcel(item))
        except KeyError:  # another thread has dropped it meanwhile, or the disk cannot be read just now
            session.retry_later(item, now)
        except Unreachable as error:
            session.unreachable(now, str(error))
        except Refused as error:
            session.refused(item, now, error.reason, str(error), error.after_s)
        else:
            reconnected = session.delivered(item)
            return Sent(window=None if isinstance(item, bytes) else item, reconnected=reconnected)
        return Sent(session.pause_left(now))


class Received(NamedTuple):
    """Result of a receiver's step.

    Attributes
    ----------
    wait_s : float
        Time to wait before the next poll.
    messages : list of (int, bytes)
        Serials, in rising order, and encoded messages.
    """

    wait_s: float
    messages: list[tuple[int, bytes]]


@dataclass(slots=True)
class Receiver:
    """Polls a transport, checks each message, and returns it once and in order.

    Parameters
    ----------
    transport : Transport
    servo, token : str
    after : int
        Serial of the last message that was handled.
    retry : Retry
    chance : callable
        Returns random numbers, uniform in 0 .. 1.

    Attributes
    ----------
    counts : Counter
        Messages received, polls that failed, and messages rejected, by reason.
    trouble : str
        Reason for which nothing is received; empty: there is none.
    """

    transport: Transport
    servo: str
    token: str = field(repr=False)
    after: int
    retry: Retry
    chance: Callable[[], float]
    counts: Counter[str] = field(default_factory=Counter)
    trouble: str = ""
    _backoff: Backoff = field(init=False)

    def __post_init__(self) -> None:
        self._backoff = Backoff(self.retry)

    def step(self) -> Received:
        """Poll once; this blocks as long as the transport does."""
        try:
            received = self.transport.listen(self.after)
        except Unreachable as error:
            return self._pause("unreachable", str(error), 0.0)
        except Refused as error:
            return self._pause(f"refused: {error.reason.value}", str(error), error.after_s)
        messages = [message for message in map(self._checked, received) if message is not None]
        if received and not messages:  # without a pause the next poll would bring the same at once, for ever
            return self._pause("nothing new", "the twin's messages are broken, repeated or not for an edge", 0.0)
        self._backoff.succeeded()
        self.trouble = ""
        return Received(0.0, messages)

    def _checked(self, data: bytes) -> tuple[int, bytes] | None:
        """Return serial and body of a message for an edge that is new and whose seal is intact; else None."""
        try:
            sealed = opened(key_of(verifier_of(self.token)), TO_EDGE, self.servo, data, MAX_BYTES)
        except InvalidMessage:
            self.counts["broken seal"] += 1
            return None
        if sealed.serial <= self.after:
            self.counts["repeated"] += 1
            return None
        # Before the body is decoded: a message that this edge does not understand must not be polled again for ever.
        self.after = sealed.serial
        return self._decoded(sealed)

    def _decoded(self, sealed: Sealed) -> tuple[int, bytes] | None:
        try:
            known = isinstance(decode(sealed.body), Update | Request | Acknowledge)
        except InvalidMessage:
            known = False
        self.counts["received" if known else "not understood"] += 1
        return (sealed.serial, sealed.body) if known else None

    def _pause(self, count: str, trouble: str, after_s: float) -> Received:
        self.counts[count] += 1
        self.trouble = trouble
        return Received(max(after_s, self._backoff.failed(self.chance())), [])
