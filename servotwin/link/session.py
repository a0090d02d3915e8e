"""Windows across an unreliable link, at least once sent and exactly once counted; no I/O, time comes in.

The edge's `Sender` repeats every window of its outbox, with growing pauses, until it is acknowledged. The twin's
`Receiver` tells new windows from repeated ones and says which one may move the parameters forward. The twin
acknowledges after it has stored a window, repeated ones too: the first acknowledgement may have been lost.
"""

from dataclasses import dataclass, field
from math import inf

from servotwin.errors import InvalidInput
from servotwin.link.outbox import Key, Outbox
from servotwin.messages import Acknowledge, Window


@dataclass(frozen=True, slots=True)
class Retry:
    """When to repeat: after `first_s`, then each pause `factor` times the last, up to `longest_s`.

    `first_s` should exceed the round trip, or every window is sent twice.
    """

    first_s: float = 5.0
    factor: float = 2.0
    longest_s: float = 60.0

    def __post_init__(self) -> None:
        if not 0.0 < self.first_s <= self.longest_s < inf:
            raise InvalidInput(f"retry from {self.first_s!r} s to {self.longest_s!r} s: must be positive and in order")
        if not 1.0 <= self.factor < inf:
            raise InvalidInput(f"retry factor = {self.factor!r}: must be at least 1")

    def pause(self, attempts: int) -> float:
        """Seconds to wait after that many attempts (one or more)."""
        pause = self.first_s
        for _ in range(attempts - 1):
            pause = min(pause * self.factor, self.longest_s)
            if pause == self.longest_s:
                break
        return pause


@dataclass(slots=True)
class _Attempt:
    """How often a window was sent and when it is due again."""

    due: float
    count: int = 0


class Sender:
    """The edge's half: what to send, and when.

    Parameters
    ----------
    outbox : Outbox
        What it already holds (after a restart) is due at once.
    retry : Retry
    """

    def __init__(self, outbox: Outbox, retry: Retry | None = None) -> None:
        self._outbox = outbox
        self._retry = retry or Retry()
        self._attempts: dict[Key, _Attempt] = {key: _Attempt(-inf) for key in outbox.pending()}

    @property
    def next_time(self) -> float | None:
        """When something is due next, s; None: everything is acknowledged or dropped."""
        return min((attempt.due for attempt in self._attempts.values()), default=None)

    def offer(self, window: Window, now: float) -> None:
        """Take charge of a window: it is due now."""
        self._attempts[window.boot, window.sequence] = _Attempt(now)
        for drop in self._outbox.put(window):
            self._attempts.pop(drop.key, None)

    def due(self, now: float) -> list[Window]:
        """The windows to send now, oldest first; each counts as sent."""
        keys = [key for key, attempt in self._attempts.items() if attempt.due <= now]
        for key in keys:
            attempt = self._attempts[key]
            attempt.count += 1
            attempt.due = now + self._retry.pause(attempt.count)
        return [self._outbox.get(key) for key in keys]

    def acknowledged(self, message: Acknowledge) -> bool:
        """The twin has a window; False when that was known."""
        key = message.boot, message.sequence
        self._attempts.pop(key, None)
        return self._outbox.remove(key)


@dataclass(slots=True)
class _Seen:
    """The sequence numbers seen of one boot: all below `below`, and those `beyond`."""

    below: int = 0
    beyond: set[int] = field(default_factory=set)
    newest: float = -inf

    def add(self, sequence: int) -> bool:
        if sequence < self.below or sequence in self.beyond:
            return False
        self.beyond.add(sequence)
        while self.below in self.beyond:
            self.beyond.remove(self.below)
            self.below += 1
        return True


class Receiver:
    """The twin's half: which windows are new, and which may move the parameters. Serves any number of servos."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], _Seen] = {}

    def accept(self, window: Window) -> bool:
        """Whether the window is new; False: seen before, acknowledge it again and do nothing else."""
        return self._of(window).add(window.sequence)

    def advance(self, window: Window) -> bool:
        """Whether the window is newer than all it has been called with before, within its boot.

        Estimates may be made in any order; parameters move forward only.
        """
        seen = self._of(window)
        newer = window.start > seen.newest
        seen.newest = max(seen.newest, window.start)
        return newer

    def _of(self, window: Window) -> _Seen:
        return self._seen.setdefault((window.servo, window.boot), _Seen())


def acknowledge(window: Window) -> Acknowledge:
    """The acknowledgement of a window."""
    return Acknowledge(window.servo, window.boot, window.sequence)
