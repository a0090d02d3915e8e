"""The edge's half of the link without I/O: it schedules the messages and handles the twin's answers.

The session repeats everything in the outbox until the twin acknowledges it: letters before windows, the oldest first.
The caller gives the time. A transport that answers each message (`link.client.Sender`) reports the answer at once; one
that does not (the simulated link) reports that a message was sent, and later its acknowledgement.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf

from servotwin.link.outbox import Key, Outbox
from servotwin.messages import Refusal
from servotwin.runtime.retry import Backoff, Retry

Item = Key | bytes
"""A window's key, or a letter's digest."""


@dataclass(slots=True)
class _Attempt:
    """Tries of one message; the next one is at `due`, s."""

    due: float
    backoff: Backoff


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
    def next_time(self) -> float | None:
        """Time at which something is due next, s; None: the outbox is empty."""
        dues = [self._due_time(item) for item in self._items()]
        return max(self._not_before, min(dues)) if dues else None

    def pause_left(self, now: float) -> float:
        """Time for which nothing is sent, s."""
        return max(0.0, self._not_before - now)

    def due(self, now: float) -> Iterator[Item]:
        """Yield the messages to be sent now, in order."""
        if now >= self._not_before:
            yield from (item for item in self._items() if self._due_time(item) <= now)

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
        else:
            self._pause(now, "refused", detail, after_s)

    def unreachable(self, now: float, detail: str) -> None:
        """Pause for all messages."""
        self._pause(now, "unreachable", detail, 0.0)

    def _pause(self, now: float, count: str, trouble: str, after_s: float) -> None:
        self.counts[count] += 1
        self.trouble = trouble
        self._not_before = now + max(after_s, self._backoff.failed(self._chance()))

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
