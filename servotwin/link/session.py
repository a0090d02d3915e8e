"""The edge's half of the link: it schedules the messages, sends them, and handles the twin's answers and messages.

The session repeats everything in the outbox until the twin acknowledges it: letters before windows, the oldest first.
The caller gives the time. A transport that answers each message (`Sender`) reports the answer at once; one
that does not (the simulated link) reports that a message was sent, and later its acknowledgement.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple

from servotwin.link.outbox import Key, Outbox
from servotwin.link.seal import TO_EDGE, Sealed, key_of, opened, verifier_of
from servotwin.link.transport import Refused, Transport, Unreachable
from servotwin.link.window_order import WindowOrder
from servotwin.messages import (
    MAX_BYTES,
    Acknowledge,
    InvalidMessage,
    LearntResponse,
    Refusal,
    Request,
    Resend,
    Update,
    decode,
)
from servotwin.runtime.retry import Backoff, Retry

_OLDER_TWIN_S = 600.0
"""s between two tries of a message that the twin's version does not know."""
_TO_EDGES = Update | Request | Acknowledge | LearntResponse | Resend
"""Messages that a twin sends to an edge."""
_NOT_KNOWN = "not understood"
"""Count of the twin's messages that this version does not know."""
Item = Key | bytes
"""A window's key, or a letter's digest."""


@dataclass(slots=True)
class _Attempt:
    """Tries of one message; the next one is at `due`, s. `unknown`: the twin is too old for it, in the twin's words."""

    due: float
    backoff: Backoff
    unknown: str = ""


class Session:
    """Retries, acknowledgements and refusals of one servo's messages to its twin.

    Parameters
    ----------
    outbox : Outbox
        Messages that it holds already, after a restart, are due at once.
    retry : Retry, optional
        Pauses, for each message and for the link as a whole.
    chance : callable, optional
        Returns random numbers, uniform in 0 .. 1, which spread the pauses; 1 by default, so that nothing is random.

    Attributes
    ----------
    counts : Counter
        Messages delivered, tries that failed, refusals by reason.
    trouble : str
        Reason for which nothing is delivered; empty: there is none.
    """

    def __init__(self, outbox: Outbox, retry: Retry | None = None, chance: Callable[[], float] = lambda: 1.0) -> None:
        self.outbox = outbox
        self.counts: Counter[str] = Counter()
        self.trouble = ""
        self._retry, self._chance = retry or Retry(), chance
        self._backoff, self._not_before = Backoff(self._retry), -inf
        self._attempts: dict[Item, _Attempt] = {}

    @property
    def not_known(self) -> str:
        """Refusal of a message that waits until the twin is upgraded; empty: there is none."""
        attempts = list(self._attempts.values())  # another thread may ask
        return next((attempt.unknown for attempt in attempts if attempt.unknown), "")

    @property
    def next_time(self) -> float | None:
        """Time at which something is due next, s; None: the outbox is empty."""
        if self._attempts:
            return self.next_time_of(self._items())
        return None if self._first() is None else self._not_before  # what was never tried is due at once

    def next_time_of(self, items: Sequence[Item]) -> float | None:
        """Time at which one of some messages of the outbox is due next, s; None: there are none."""
        dues = [self._due_time(item) for item in items]
        return max(self._not_before, min(dues)) if dues else None

    def pause_left(self, now: float) -> float:
        """Time for which nothing is sent, s."""
        return max(0.0, self._not_before - now)

    def due(self, now: float) -> Iterator[Item]:
        """Yield the messages to be sent now, in order."""
        if now >= self._not_before:
            yield from (item for item in self._items() if self._due_time(item) <= now)

    def first_due(self, now: float) -> Item | None:
        """The first message of `due`; None: there is none."""
        if self._attempts:
            return next(self.due(now), None)
        return self._first() if now >= self._not_before else None

    def is_due(self, item: Item, now: float) -> bool:
        """True where a message of the outbox may be sent now."""
        return now >= self._not_before and self._due_time(item) <= now

    def retry_later(self, item: Item, now: float, after_s: float = 0.0) -> None:
        """Schedule a message that was sent, or could not be read, after its next pause, at least `after_s`."""
        attempt = self._attempts.setdefault(item, _Attempt(now, Backoff(self._retry)))
        attempt.due = now + max(after_s, attempt.backoff.failed(self._chance()))

    def acknowledge(self, item: Item) -> bool:
        """Remove a message that the twin has; False when it was not in the outbox."""
        self._attempts.pop(item, None)
        return self.outbox.remove_letter(item) if isinstance(item, bytes) else self.outbox.remove(item)

    def delivered(self, item: Item) -> bool:
        """Remove a message that the twin has acknowledged; True when the twin was out of reach before."""
        reconnected, self.trouble = bool(self.trouble), ""
        self._backoff.succeeded()
        self.counts["letters" if isinstance(item, bytes) else "windows"] += 1
        self.acknowledge(item)
        return reconnected

    def refused(self, item: Item, now: float, reason: Refusal, detail: str, after_s: float) -> None:
        """Handle a refusal: drop the message, retry it later, or pause the link, as the reason says."""
        self.counts[f"refused: {reason.value}"] += 1
        if not reason.temporary:
            if isinstance(item, bytes):
                self.outbox.remove_letter(item)
            else:
                self.outbox.drop(item, reason.value)
        elif reason is Refusal.FUTURE:  # concerns this message only: the others go on
            self.retry_later(item, now, after_s)
        elif reason is Refusal.UNKNOWN_SCHEMA:  # so does this; it lasts until the twin is upgraded
            self.retry_later(item, now, max(after_s, _OLDER_TWIN_S))
            self._attempts[item].unknown = detail
        else:
            self._pause(now, "refused", detail, after_s)

    def twin_is_back(self, now: float) -> None:
        """Make messages due that the twin did not know: it may have been upgraded meanwhile."""
        for attempt in list(self._attempts.values()):  # another thread may send meanwhile
            if attempt.unknown:
                attempt.due = min(attempt.due, now)

    def unreachable(self, now: float, detail: str) -> None:
        """Pause for all messages."""
        self._pause(now, "unreachable", detail, 0.0)

    def _pause(self, now: float, count: str, trouble: str, after_s: float) -> None:
        self.counts[count] += 1
        self.trouble = trouble
        self._not_before = now + max(after_s, self._backoff.failed(self._chance()))

    def _first(self) -> Item | None:
        return next(iter(self.outbox.letters()), None) or self.outbox.oldest()

    def _items(self) -> list[Item]:
        items: list[Item] = [*self.outbox.letters(), *self.outbox.pending()]
        if self._attempts:  # the outbox may have dropped some by itself
            for dropped in self._attempts.keys() - set(items):
                del self._attempts[dropped]
        return items

    def _due_time(self, item: Item) -> float:
        attempt = self._attempts.get(item)
        # A message that was never tried is due at once, whatever time it is.
        return -inf if attempt is None else attempt.due


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
    """Delivers the messages that are due in a session: letters, then windows in the order of `WindowOrder`.

    Parameters
    ----------
    session : Session
    transport : Transport
    """

    session: Session
    transport: Transport
    _order: WindowOrder = field(default_factory=WindowOrder)
    _newest: Key | None = None
    _boots: frozenset[str] = frozenset()

    def step(self, now: float) -> Sent:
        """Deliver the message that is due, if one is."""
        session, newest = self.session, self._fresh()
        item = self._next(now, newest)
        if item is None:
            return Sent(self._wait(now))
        try:
            pause = self._deliver(item)
        except KeyError:  # another thread has dropped it meanwhile, or the disk cannot be read just now
            session.retry_later(item, now)
        except Unreachable as error:
            session.unreachable(now, str(error))
            self._order.out_of_reach()
        except Refused as error:
            session.refused(item, now, error.reason, str(error), error.after_s)
        else:
            if not isinstance(item, bytes):
                self._note_taken(item, item == newest, now, pause)
            reconnected = session.delivered(item)
            return Sent(window=None if isinstance(item, bytes) else item, reconnected=reconnected)
        return Sent(session.pause_left(now))

    def _deliver(self, item: Item) -> float:
        """Deliver a message; return the pause that the twin asks for before older windows, s."""
        outbox = self.session.outbox
        if isinstance(item, bytes):
            return self.transport.deliver(outbox.letter(item))
        return self.transport.deliver(outbox.parcel(item)._replace(waiting=outbox.waiting - 1))

    def _next(self, now: float, newest: Key | None) -> Item | None:
        """The message to be sent now; None: none is due, or those that are have to wait for the end of a pause."""
        first = self.session.first_due(now)
        if first is None or isinstance(first, bytes):
            return first
        if newest is not None and not self.session.is_due(newest, now):
            newest = None
        return self._order.next(now, first, newest, self.session.outbox.waiting - 1)

    def _fresh(self) -> Key | None:
        """The newest window, unless the twin has had a newer one."""
        newest = self.session.outbox.newest()
        if newest is None or self._newest is None:
            return newest
        boot, sequence = newest
        if boot == self._newest[0]:
            return newest if sequence > self._newest[1] else None
        return None if boot in self._boots else newest

    def _note_taken(self, window: Key, fresh: bool, now: float, pause: float) -> None:
        """Note that the twin has taken a window and asks for a pause (s) before older ones."""
        if fresh:
            if self._newest is None or window[0] != self._newest[0]:
                # Of the boots before this one, nothing that is still there is newer.
                self._boots = frozenset(boot for boot, _ in self.session.outbox.pending())
            self._newest = window
        self._order.taken(now, fresh, self.session.outbox.waiting - 1, pause)

    def _wait(self, now: float) -> float:
        """Time until something is due, s."""
        session, pause = self.session, self._order.pause_left(now)
        due = session.next_time
        if not pause or due is None:
            return inf if due is None else due - now
        newest = self._fresh()
        exempt: list[Item] = [*session.outbox.letters(), *([] if newest is None else [newest])]
        sooner = session.next_time_of(exempt)
        return max(pause, due - now) if sooner is None else min(max(pause, due - now), sooner - now)


class Received(NamedTuple):
    """Result of a receiver's step.

    Attributes
    ----------
    wait_s : float
        Time to wait before the next poll.
    messages : list of (int, bytes)
        Serials, in rising order, and encoded messages.
    reconnected : bool
        The twin answers again after it did not.
    """

    wait_s: float
    messages: list[tuple[int, bytes]]
    reconnected: bool = False


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
        """Poll once; this blocks as long as the transport does.

        After a trouble the twin answers at once: otherwise the trouble would seem to last until it has news.
        """
        try:
            received = self.transport.listen(self.after, at_once=bool(self.trouble))
        except Unreachable as error:
            return self._pause("unreachable", str(error), 0.0)
        except Refused as error:
            return self._pause(f"refused: {error.reason.value}", str(error), error.after_s)
        unknown = self.counts[_NOT_KNOWN]
        messages = [message for message in map(self._checked, received) if message is not None]
        if received and not messages:  # without a pause the next poll would bring the same at once, for ever
            return self._pause("nothing new", self._why_none(unknown), 0.0)
        self._backoff.succeeded()
        reconnected, self.trouble = bool(self.trouble), ""
        return Received(0.0, messages, reconnected)

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
            known = isinstance(decode(sealed.body), _TO_EDGES)
        except InvalidMessage:
            known = False
        self.counts["received" if known else _NOT_KNOWN] += 1
        return (sealed.serial, sealed.body) if known else None

    def _why_none(self, unknown_before: int) -> str:
        """Reason for which there is no message for the edge among those that came."""
        if self.counts[_NOT_KNOWN] > unknown_before:
            return "the twin is newer: this edge does not know its message"
        return "the twin's messages are broken, repeated or not for an edge"

    @property
    def not_known(self) -> int:
        """Number of messages of a twin that is newer than this edge."""
        return self.counts[_NOT_KNOWN]

    def _pause(self, count: str, trouble: str, after_s: float) -> Received:
        self.counts[count] += 1
        self.trouble = trouble
        return Received(max(after_s, self._backoff.failed(self.chance())), [])
