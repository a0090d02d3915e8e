"""Decisions about the twin's requests for longer windows and probing moves. Pure functions.

A request that was decided gets its first answer again, so that a lost answer costs nothing. One that came too soon, or
while the reference moved, stays undecided: the same request may be granted later.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

from servotwin.edge.guard import Instant
from servotwin.edge.probe import ProbeLimits, ProbingMove
from servotwin.edge.settings import AgentSettings
from servotwin.messages import Answer, LongerWindow, Probe, Request, RequestOutcome


@dataclass(frozen=True, slots=True)
class GrantedRequests:
    """Window lengths and probing move in force after the requests so far.

    Parameters
    ----------
    window, pre_trigger : int
        Samples of a window, and those of them before the change of the reference.
    probe : ProbingMove, optional
        Move under way.
    probed : int, optional
        First sample of the last probing move.
    answer : Answer, optional
        Answer to the last request that was decided.
    """

    window: int
    pre_trigger: int
    probe: ProbingMove | None = None
    probed: int | None = None
    answer: Answer | None = None

    @property
    def newest(self) -> int:
        """Highest serial decided."""
        return 0 if self.answer is None else self.answer.serial


class RequestDecision(NamedTuple):
    """State after a request, and the answer to it."""

    state: GrantedRequests
    answer: Answer


def decide(
    request: Request, state: GrantedRequests, settings: AgentSettings, here: Instant, at_rest: bool
) -> RequestDecision:
    """Grant a request, or refuse it with a reason.

    Parameters
    ----------
    request : Request
    state : GrantedRequests
    settings : AgentSettings
        Limits of windows and probing moves.
    here : Instant
    at_rest : bool
        The reference rests, and no window is being recorded.
    """
    if state.answer is not None and _is_for(request, here) and request.serial == state.newest:
        return RequestDecision(state, state.answer)
    outcome = _judge(request, state, settings, here, at_rest)
    answer = Answer(here.servo, here.boot, request.serial, here.sample, outcome, state.newest)
    if outcome.temporary or not _is_for(request, here) or outcome is RequestOutcome.DUPLICATE:
        return RequestDecision(state, answer)
    state = replace(state, answer=Answer(here.servo, here.boot, request.serial, here.sample, outcome, request.serial))
    state = _grant(request, state, settings, here) if outcome is RequestOutcome.ACCEPTED else state
    assert state.answer is not None
    return RequestDecision(state, state.answer)


def _is_for(request: Request, here: Instant) -> bool:
    """True where it was made for this edge and boot."""
    return request.servo == here.servo and request.boot == here.boot


def _judge(
    request: Request, state: GrantedRequests, settings: AgentSettings, here: Instant, at_rest: bool
) -> RequestOutcome:
    checks = (
        (request.servo == here.servo, RequestOutcome.WRONG_SERVO),
        (request.boot == here.boot, RequestOutcome.OTHER_BOOT),
        (request.serial > state.newest, RequestOutcome.DUPLICATE),
        (here.time < request.not_after, RequestOutcome.EXPIRED),
    )
    outcome = next((outcome for passed, outcome in checks if not passed), RequestOutcome.ACCEPTED)
    if outcome is not RequestOutcome.ACCEPTED:
        return outcome
    if isinstance(request.ask, LongerWindow):
        return _judge_window(request.ask, settings)
    return _judge_probe(request.ask, state, settings, here, at_rest)


def _judge_window(ask: LongerWindow, settings: AgentSettings) -> RequestOutcome:
    longest, earliest = settings.longest_samples, settings.longest_pre_trigger_samples
    window, before = (round(seconds * settings.sample_rate) for seconds in (ask.window_s, ask.pre_trigger_s))
    return RequestOutcome.ACCEPTED if window <= longest and before <= earliest else RequestOutcome.TOO_LARGE


def _judge_probe(
    ask: Probe, state: GrantedRequests, settings: AgentSettings, here: Instant, at_rest: bool
) -> RequestOutcome:
    limits = settings.probe
    if limits is None:
        return RequestOutcome.NOT_ALLOWED
    move = ProbingMove.of(ask, here.sample, here.rate)
    checks = (
        (abs(ask.size) <= limits.size, RequestOutcome.TOO_LARGE),
        (state.pre_trigger + move.last - move.first <= settings.longest_samples, RequestOutcome.TOO_LARGE),
        (_rested(state, limits, here), RequestOutcome.TOO_SOON),
        (at_rest and state.probe is None, RequestOutcome.BUSY),
    )
    return next((outcome for passed, outcome in checks if not passed), RequestOutcome.ACCEPTED)


def _rested(state: GrantedRequests, limits: ProbeLimits, here: Instant) -> bool:
    """True where the last probing move is long enough ago."""
    return state.probed is None or here.sample - state.probed >= limits.interval_s * here.rate


def _grant(request: Request, state: GrantedRequests, settings: AgentSettings, here: Instant) -> GrantedRequests:
    """Apply a request; windows never get shorter than configured."""
    ask, rate = request.ask, settings.sample_rate
    if isinstance(ask, Probe):
        return replace(state, probe=ProbingMove.of(ask, here.sample, rate), probed=here.sample)
    window, before = round(ask.window_s * rate), round(ask.pre_trigger_s * rate)
    window, before = max(window, settings.window_samples), max(before, settings.pre_trigger_samples)
    return replace(state, window=window, pre_trigger=before)
