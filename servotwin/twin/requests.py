"""Requests for more informative windows: one at a time, each repeated until it is answered. An optional part, pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from dataclasses import replace as changed

from msgspec import Struct
from msgspec.structs import replace

from servotwin.estimation.estimate import GapEstimate
from servotwin.messages import PROBE, TEACHING, Answer, Probe, Request, RequestOutcome, Setting, WindowMessage
from servotwin.plant.display_units import position_unit
from servotwin.plant.plants import Plant
from servotwin.redesign.excitation import Decision, ExcitationPolicy, ExcitationState, WindowSummary, long_enough
from servotwin.twin.settings import TwinSettings


class Attempts(Struct, frozen=True):
    """Sendings of one message.

    Attributes
    ----------
    sent_at : float
        Time of the last one, s.
    count : int
    """

    sent_at: float = -math.inf
    count: int = 0

    def another(self, now: float) -> Attempts:
        """Count one more at `now`, s."""
        return Attempts(now, self.count + 1)

    def not_after(self, now: float) -> Attempts:
        """Copy with the last sending at `now` (s) at the latest, for a clock that was set back."""
        return self if self.sent_at <= now else Attempts(now, self.count)


class RequestState(Struct, frozen=True):
    """Part of the twin's state that belongs to requests.

    Attributes
    ----------
    pending : Request or None
        Request that was sent and is not answered yet.
    excitation : ExcitationState
    boot : str
        Boot of the edge.
    serial : int
        Highest serial used in this boot.
    attempts : Attempts
        Sendings of the pending request.
    """

    pending: Request | None = None
    excitation: ExcitationState = ExcitationState()
    boot: str = ""
    serial: int = 0
    attempts: Attempts = Attempts()

    def not_after(self, now: float) -> RequestState:
        """Copy in which no time is later than `now` (s), for a clock that was set back."""
        excitation = self.excitation
        if excitation.probed > now:
            excitation = changed(excitation, probed=now)
        return replace(self, attempts=self.attempts.not_after(now), excitation=excitation)

    def closed(self, outcome: RequestOutcome | None) -> RequestState:
        """Copy without the pending request, whose outcome is noted; None: the edge never answered."""
        assert self.pending is not None
        return replace(self, excitation=self.excitation.answered(self.pending.ask, outcome), pending=None)


@dataclass(frozen=True)
class Requests:
    """Decides what to request after each window, and repeats it.

    Parameters
    ----------
    policy : ExcitationPolicy
    retry : float
        s without an answer after which a request is sent again.
    attempts : int
        Number of sendings after which a request is abandoned.
    validity : float
        s after a window's first sample, within which the edge may begin the request that followed from it.
    widest : float
        Upper bound of the gap, rad.
    """

    policy: ExcitationPolicy
    retry: float
    attempts: int
    validity: float
    widest: float

    @classmethod
    def of(cls, servo: Plant, settings: TwinSettings) -> Requests | None:
        """Make the part that a twin's settings describe; None: the twin requests nothing."""
        if settings.excitation is None:
            return None
        policy = ExcitationPolicy(servo.p, settings.excitation, position_unit(servo))
        return cls(policy, settings.retry, settings.attempts, settings.valid_for, settings.uncertainty.gap[1])

    def decide(
        self,
        state: RequestState,
        window: WindowMessage,
        estimate: GapEstimate,
        widest: float,
        in_force: Setting | None,
        now: float,
    ) -> tuple[RequestState, Decision]:
        """Decide about a request after a window; a new one becomes pending and counts as sent.

        Parameters
        ----------
        state : RequestState
        window : WindowMessage
        estimate : GapEstimate
            Estimate from the window.
        widest : float
            Upper bound of the gap from the trend, rad.
        in_force : Setting or None
        now : float
            s.
        """
        if window.boot != state.boot:
            state = RequestState(boot=window.boot, excitation=state.excitation.rebooted(), attempts=state.attempts)
        long = window.reason in (PROBE, TEACHING) or long_enough(*_extent(window), self.policy.settings)
        upper = min(self.widest, widest, estimate.interval[1])
        taught, contact = estimate.ok and estimate.machine is not None, estimate.contact
        first = contact is not None and contact.between is not None and math.isnan(contact.between.rate)
        slack, ratio = _slack(in_force), estimate.ratio
        summary = WindowSummary(now, estimate.status, long, upper, slack, ratio, estimate.rms, taught, first)
        decision = self.policy.decide(state.excitation, summary)
        state = replace(state, excitation=decision.state)
        if estimate.ok and state.pending is not None and isinstance(state.pending.ask, Probe):
            state = state.closed(None)
        if decision.ask is None:
            return state, decision
        serial, until = state.serial + 1, window.start + self.validity
        request = Request(window.servo, state.boot, serial, decision.ask, until, decision.reason[:256])
        return replace(state, pending=request, serial=serial, attempts=Attempts(now, 1)), decision

    def answered(self, state: RequestState, answer: Answer, now: float) -> tuple[RequestState, Request | None]:
        """Return the state after an answer, and the request to send instead where its serial was used before."""
        pending = state.pending
        if (
            pending is None
            or (answer.boot, answer.serial) != (pending.boot, pending.serial)
            or answer.outcome.temporary
        ):
            return state, None
        if answer.outcome is not RequestOutcome.DUPLICATE:
            return state.closed(answer.outcome), None
        serial = max(state.serial, answer.newest) + 1
        # A twin that lost its state counts from 1 again, and the edge takes the serial for a repetition.
        renumbered = replace(pending, serial=serial)
        return replace(state, pending=renumbered, serial=serial, attempts=Attempts(now, 1)), renumbered

    def next_wake(self, state: RequestState) -> float | None:
        """Time at which the answer is overdue, s; None: no request is pending."""
        return None if state.pending is None else state.attempts.sent_at + self.retry

    def wake(self, state: RequestState, now: float) -> tuple[RequestState, tuple[Request, ...]]:
        """Repeat the pending request when its answer is overdue; abandon it after `attempts` sendings."""
        due = self.next_wake(state)
        if state.pending is None or due is None or now < due:
            return state, ()
        if state.attempts.count >= self.attempts:
            return state.closed(None), ()
        return replace(state, attempts=state.attempts.another(now)), (state.pending,)


def _extent(window: WindowMessage) -> tuple[float, float]:
    """Length of a window, and of its part before the first change of the reference, s.

    The second is inf for a window that begins with the boot's first sample: no pre-trigger could be longer.
    """
    first = next((time for time, _ in window.reference_changes), window.start)
    return window.samples / window.rate, math.inf if window.start == 0.0 else first - window.start


def _slack(setting: Setting | None) -> float:
    """Sum of both thresholds of the dead zone in which the loop opens, m; NaN: not known."""
    if setting is None or setting.gains is None:
        return math.nan
    if setting.gains.integral_only:
        return 0.0
    return (setting.gains.enter + setting.gains.leave) * setting.tolerance
