"""What a twin asks its edge for when windows tell too little: one request at a time, repeated until it is answered."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec

from servotwin.estimation.estimate import GapEstimate
from servotwin.messages import Answer, Outcome, Probe, Request, Setting, Window
from servotwin.plant.servo import Servo
from servotwin.redesign.excitation import Decision, ExcitationPolicy, Memory, Seen, long_enough
from servotwin.twin.settings import TwinSettings
from servotwin.twin.store import Store


@dataclass(frozen=True)
class Insistence:
    """How a twin insists.

    Attributes
    ----------
    retry : float
        s without an answer after which a request is sent again.
    attempts : int
        How often it is sent before it is given up.
    validity : float
        s after a window's first sample for which a request that stands on it may still be begun.
    """

    retry: float = 5.0
    attempts: int = 4
    validity: float = 60.0


class Requests:
    """Windows and answers in, requests out.

    Parameters
    ----------
    servo : str
    policy : ExcitationPolicy
    insistence : Insistence
    widest : float
        rad: the gap is no wider than this.
    """

    def __init__(self, servo: str, policy: ExcitationPolicy, insistence: Insistence, widest: float) -> None:
        self.servo, self.policy, self.insistence, self.widest = servo, policy, insistence, widest
        self.pending: Request | None = None
        self.memory, self.boot, self.serial = Memory(), "", 0
        self.sent_at, self.attempts = -math.inf, 0

    def learn(self, window: Window, estimate: GapEstimate, widest: float, runs: Setting | None, now: float) -> Decision:
        """Decide after a window; what is asked for is `pending` then.

        Parameters
        ----------
        window : Window
        estimate : GapEstimate
            What it says of the gap.
        widest : float
            rad: what else bounds the gap from above.
        runs : Setting or None
            In force at the edge; None: not known.
        now : float
            s.
        """
        if window.boot != self.boot:
            self.boot, self.serial, self.memory, self.pending = window.boot, 0, self.memory.rebooted(), None
        long = window.reason == "probe" or long_enough(*_extent(window), self.policy.settings)
        upper = min(self.widest, widest, estimate.interval[1])
        decision = self.policy.look(self.memory, Seen(now, estimate.status, long, upper, _slack(runs)))
        self.memory = decision.memory
        if estimate.ok and self.pending is not None and isinstance(self.pending.ask, Probe):
            self._close(None)
        if decision.ask is not None:
            until = window.start + self.insistence.validity
            self.serial += 1
            self.pending = Request(self.servo, self.boot, self.serial, decision.ask, until, decision.reason[:256])
            self.attempts = 0
        return decision

    def after(
        self, window: Window, estimate: GapEstimate, widest: float, runs: Setting | None, store: Store, now: float
    ) -> list[Request]:
        """What to send after a window, as of `learn`; decision and request are stored."""
        decision = self.learn(window, estimate, widest, runs, now)
        store.add_excitation(window, decision)
        return self._stored(self.pending if decision.ask else None, store, now)

    def answered(self, answer: Answer, store: Store, now: float) -> list[Request]:
        """What to send after an answer, as of `settle`, stored."""
        return self._stored(self.settle(answer), store, now)

    def settle(self, answer: Answer) -> Request | None:
        """Note an answer; the request to send instead, where this twin had forgotten how far its numbers went."""
        asked = self.pending
        if asked is None or (answer.boot, answer.serial) != (asked.boot, asked.serial) or answer.outcome.passing:
            return None
        if answer.outcome is Outcome.DUPLICATE:
            self.serial = max(self.serial, answer.newest) + 1
            self.pending = msgspec.structs.replace(asked, serial=self.serial)
            self.attempts = 0
            return self.pending
        self._close(answer.outcome)
        return None

    def send(self, now: float) -> list[Request]:
        """The pending request, which counts as sent."""
        if self.pending is None:
            return []
        self.sent_at, self.attempts = now, self.attempts + 1
        return [self.pending]

    def steady(self, now: float) -> None:
        """Nothing happened later than `now` (s), whatever the clock said then."""
        self.sent_at = min(self.sent_at, now)
        self.memory = replace(self.memory, probed=min(self.memory.probed, now))

    def next_wake(self) -> float | None:
        """When `wake` is due, s; None: nothing is waited for."""
        return None if self.pending is None else self.sent_at + self.insistence.retry

    def wake(self, now: float) -> list[Request]:
        """The pending request once more when its answer is overdue; given up after `attempts`."""
        due = self.next_wake()
        if due is None or now < due:
            return []
        if self.attempts >= self.insistence.attempts:
            self._close(None)
        return self.send(now)

    def _stored(self, request: Request | None, store: Store, now: float) -> list[Request]:
        """Store and send a new request."""
        if request is None:
            return []
        store.add_request(request)
        return self.send(now)

    def _close(self, outcome: Outcome | None) -> None:
        """The pending request is over."""
        assert self.pending is not None
        self.memory = self.memory.answered(self.pending.ask, outcome)
        self.pending = None


def requests_of(name: str, servo: Servo, settings: TwinSettings) -> Requests | None:
    """What a twin's settings ask for, of a servo of that name and model; None: nothing."""
    if settings.excitation is None:
        return None
    insistence = Insistence(settings.retry, settings.attempts, settings.validity)
    return Requests(name, ExcitationPolicy(servo.p, settings.excitation), insistence, settings.uncertainty.gap[1])


def _extent(window: Window) -> tuple[float, float]:
    """Length, and how much of it lies before the first change of the reference, s.

    Nothing lies before a boot's first sample: there, no longer pre-trigger could be had.
    """
    first = next((time for time, _ in window.reference_changes), window.start)
    return window.samples / window.rate, math.inf if window.start == 0.0 else first - window.start


def _slack(runs: Setting | None) -> float:
    """m: both thresholds of the dead zone together; NaN: not known."""
    if runs is None or runs.gains is None:
        return math.nan
    return (runs.gains.enter + runs.gains.leave) * runs.tolerance
