"""What a co-simulation returns: the trajectory, and everything that crossed the link."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass

from servotwin.cosim.scenario import Scenario
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.estimation.passage import Passage
from servotwin.estimation.trend import Trend
from servotwin.link.simulated import Fate
from servotwin.messages import Answer, Fallback, Message, Receipt, Request, Update, Window, decode
from servotwin.redesign.excitation import Decision
from servotwin.redesign.policy import Redesign
from servotwin.simulation import Run

TRAJECTORY = ("position", "theta_m", "theta_d", "voltage", "measured_position", "tolerance")


@dataclass(frozen=True)
class Transmission:
    """One copy of a message on its way.

    Attributes
    ----------
    direction : str
        "up", edge to twin, or "down".
    serial, copy : int
        The message's number in its direction; 1 for a duplicate.
    data : bytes
    sent, arrival : float
        s; a lost one's arrival is when it would have come.
    fate : Fate
    """

    direction: str
    serial: int
    copy: int
    data: bytes
    sent: float
    arrival: float
    fate: Fate

    @property
    def message(self) -> Message:
        """What the bytes say."""
        return decode(self.data)


@dataclass(frozen=True)
class Loop:
    """What a co-simulation returns.

    Attributes
    ----------
    scenario : Scenario
    run : Run
        The trajectory.
    windows : tuple of messages.Window
        As decoded by the twin, each once, in the order of arrival.
    estimates : tuple of GapEstimate
        One for each window.
    disturbances : tuple of Disturbance
        Input bias and noise, one for each window.
    trends : tuple of Trend or None
        Gap and rate of wear as the twin knew them after each window; None before the first accepted estimate.
    redesigns : tuple of Redesign
        What was made of each window, or why nothing was.
    updates : tuple of messages.Update
        Every version that the twin gave out.
    receipts : tuple of messages.Receipt
        Every decision of the edge, in its order (repeated answers included).
    fallbacks : tuple of messages.Fallback
        When and why the edge left the twin's parameters.
    excitations : tuple of redesign.excitation.Decision
        What the twin asked for after a window, or why nothing; one for each window that was looked at.
    requests : tuple of messages.Request
        Every request of the twin for windows that tell more.
    answers : tuple of messages.Answer
        Every answer of the edge to one, repeated answers included.
    messages : tuple of Transmission
        Every copy of every message, in the order of sending.
    accounts : Counter
        Windows cut by the edge: "delivered", "in flight" (kept at the edge, not at the twin), or why they were dropped.
    """

    scenario: Scenario
    run: Run
    windows: tuple[Window, ...]
    estimates: tuple[GapEstimate, ...]
    disturbances: tuple[Disturbance, ...]
    trends: tuple[Trend | None, ...]
    redesigns: tuple[Redesign, ...]
    updates: tuple[Update, ...]
    receipts: tuple[Receipt, ...]
    fallbacks: tuple[Fallback, ...]
    excitations: tuple[Decision, ...]
    requests: tuple[Request, ...]
    answers: tuple[Answer, ...]
    messages: tuple[Transmission, ...]
    accounts: Counter[str]

    @property
    def applied(self) -> tuple[Receipt, ...]:
        """The first receipt of each update that was applied, in order."""
        first = {receipt.version: receipt for receipt in reversed(self.receipts) if receipt.applied}
        return tuple(sorted(first.values(), key=lambda receipt: receipt.sample))

    @property
    def trend(self) -> Trend | None:
        """What is known of the wear in the end."""
        return self.trends[-1] if self.trends else None

    @property
    def until_limit(self) -> Passage | None:
        """How long after `trend.time` the gap reaches the scenario's `gap_limit`; None without limit or trend."""
        limit = self.scenario.twin.gap_limit
        return None if limit is None or self.trend is None else self.trend.time_until(limit)

    def digest(self) -> str:
        """SHA-256 over every message (bytes, times, fate) and the trajectory: equal only for runs equal bit for bit."""
        total = hashlib.sha256()
        for m in self.messages:
            total.update(
                f"{m.direction} {m.serial} {m.copy} {m.sent!r} {m.arrival!r} {m.fate} {len(m.data)}\n".encode()
            )
            total.update(m.data)
        for name in TRAJECTORY:
            total.update(getattr(self.run, name).tobytes())
        return total.hexdigest()
