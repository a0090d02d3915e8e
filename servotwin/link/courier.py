"""The edge's sending: letters, then windows, the oldest first, each until the twin has it; time comes from outside."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

from servotwin.link.outbox import Key
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.link.transport import Parcel, Refused, Transport, Unreachable
from servotwin.messages import Refusal
from servotwin.runtime.retry import Backoff, Retry

Item = Key | bytes
"""A window's key or a letter's digest."""


@dataclass(slots=True)
class Sent:
    """What came of a step.

    Attributes
    ----------
    wait_s : float
        How long nothing is due; inf: until something is put into the outbox.
    window : Key, optional
        The twin has this window now.
    back : bool
        The twin was out of reach before.
    """

    wait_s: float = 0.0
    window: Key | None = None
    back: bool = False


@dataclass(slots=True)
class Held:
    """A message that may be sent later."""

    due: float
    pauses: Backoff


@dataclass(slots=True)
class Courier:
    """Delivers what is in an outbox; one step is one message.

    Parameters
    ----------
    outbox : SqliteOutbox
    transport : Transport
    retry : Retry
    chance : callable
        Uniform in 0 .. 1.
    counts : Counter
        Messages delivered, tries that failed, refusals by reason.
    trouble : str
        Why nothing is delivered; empty: it is.
    """

    outbox: SqliteOutbox
    transport: Transport
    retry: Retry
    chance: Callable[[], float]
    counts: Counter[str] = field(default_factory=Counter)
    trouble: str = ""
    _pauses: Backoff = field(init=False)
    _not_before: float = -inf
    _held: dict[Item, Held] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._pauses = self._fresh()

    def step(self, now: float) -> Sent:
        """Deliver the message that is due, if one is."""
        if now < self._not_before:
            return Sent(self._not_before - now)
        item = self._next(now)
        if item is None:
            return Sent(min((held.due for held in self._held.values()), default=inf) - now)
        try:
            self.transport.deliver(self._parcel(item))
        except KeyError:  # dropped meanwhile, or its file cannot be read just now
            self._hold(item, now, 0.0)
            return Sent()
        except Unreachable as error:
            return self._pause(now, "unreachable", str(error), 0.0)
        except Refused as error:
            return self._refused(item, now, error)
        return self._delivered(item)

    def _next(self, now: float) -> Item | None:
        """What is not held, or not any more; a letter goes first."""
        waiting: list[Item] = [*self.outbox.letters(), *self.outbox.pending()]
        for gone in self._held.keys() - set(waiting):
            del self._held[gone]
        return next((item for item in waiting if item not in self._held or self._held[item].due <= now), None)

    def _parcel(self, item: Item) -> Parcel:
        return self.outbox.letter(item) if isinstance(item, bytes) else self.outbox.parcel(item)

    def _delivered(self, item: Item) -> Sent:
        back, self.trouble = bool(self.trouble), ""
        self._pauses.succeeded()
        self._held.pop(item, None)
        if isinstance(item, bytes):
            self.counts["letters"] += 1
            self.outbox.taken(item)
            return Sent(back=back)
        self.counts["windows"] += 1
        self.outbox.remove(item)
        return Sent(window=item, back=back)

    def _refused(self, item: Item, now: float, error: Refused) -> Sent:
        """Drop and count what will never be taken; hold what is too early; wait where nothing is taken just now."""
        self.counts[f"refused: {error.reason.value}"] += 1
        if not error.reason.passing:
            if isinstance(item, bytes):
                self.outbox.taken(item)
            else:
                self.outbox.drop(item, error.reason.value)
            return Sent()
        if error.reason is Refusal.FUTURE:
            self._hold(item, now, error.after_s)
            return Sent()
        return self._pause(now, "refused", str(error), error.after_s)

    def _hold(self, item: Item, now: float, after_s: float) -> None:
        """Let others go first for a while."""
        held = self._held.setdefault(item, Held(now, self._fresh()))
        held.due = now + max(after_s, held.pauses.failed(self.chance()))

    def _pause(self, now: float, what: str, trouble: str, after_s: float) -> Sent:
        self.counts[what] += 1
        self.trouble = trouble
        wait = max(after_s, self._pauses.failed(self.chance()))
        self._not_before = now + wait
        return Sent(wait)

    def _fresh(self) -> Backoff:
        return Backoff(self.retry)
