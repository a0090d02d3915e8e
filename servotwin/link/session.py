"""The edge's half of the session: windows repeated until they are acknowledged; no I/O, time comes in.

Every window is sent at least once and repeated with growing pauses. The twin acknowledges a window after it has stored
it under its unique (servo, boot, sequence), and a repeated one again, since the first acknowledgement may have been
lost: so each window counts once, over any transport.
"""

from dataclasses import dataclass
from math import inf

from servotwin.link.outbox import Key, Outbox
from servotwin.messages import Acknowledge, Window
from servotwin.runtime.retry import Retry


@dataclass(slots=True)
class _Attempt:
    """When a window is due, and how long to wait after that."""

    due: float
    pause: float


class Sender:
    """What to send, and when.

    Parameters
    ----------
    outbox : Outbox
        What it already holds (after a restart) is due at once.
    retry : Retry
    """

    def __init__(self, outbox: Outbox, retry: Retry | None = None) -> None:
        self._outbox = outbox
        self._retry = retry or Retry()
        self._attempts: dict[Key, _Attempt] = {key: _Attempt(-inf, self._retry.first_s) for key in outbox.pending()}

    @property
    def next_time(self) -> float | None:
        """When something is due next, s; None: everything is acknowledged or dropped."""
        return min((attempt.due for attempt in self._attempts.values()), default=None)

    def offer(self, window: Window, now: float) -> None:
        """Take charge of a window: it is due now."""
        self._attempts[window.boot, window.sequence] = _Attempt(now, self._retry.first_s)
        for drop in self._outbox.put(window):
            self._attempts.pop(drop.key, None)

    def due(self, now: float) -> list[Window]:
        """The windows to send now, oldest first; each counts as sent."""
        keys = [key for key, attempt in self._attempts.items() if attempt.due <= now]
        for key in keys:
            attempt = self._attempts[key]
            attempt.due = now + attempt.pause
            attempt.pause = min(attempt.pause * self._retry.factor, self._retry.longest_s)
        return [self._outbox.get(key) for key in keys]

    def acknowledged(self, message: Acknowledge) -> bool:
        """The twin has a window; False when that was known."""
        key = message.boot, message.sequence
        self._attempts.pop(key, None)
        return self._outbox.remove(key)
