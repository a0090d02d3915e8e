"""Decides about the twin's requests: pure, what is asked for goes in, what is granted comes out.

A request that was decided gets its first answer again, so that a lost answer costs nothing. One that came at a bad
moment is not decided: the same request may be taken later.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

from servotwin.edge.guard import Instant
from servotwin.edge.probe import ProbeLimits, ProbingMove
from servotwin.edge.settings import AgentSettings
from servotwin.messages import Answer, LongerWindow, Outcome, Probe, Request


@dataclass(frozen=True, slots=True)
class Granted:
    """What requests have led to.

    Parameters
    ----------
    window, pre_trigger : int
        Samples of a window, and of it before the change of the reference.
    probe : ProbingMove, optional
        Under way.
    probed : int, optional
        First sample of the last probing move.
    answer : Answer, optional
        To the last request that was decided.
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


class Decided(NamedTuple):
    """State and answer."""

    granted: Granted
    answer: Answer


def decide(request: Request, granted: Granted, settings: AgentSettings, here: Instant, calm: bool) -> Decided:
    """Take a request, or say why not.

    Parameters
    ----------
    request : Request
    granted : Granted
    settings : AgentSettings
        What is allowed.
    here : Instant
    calm : bool
        Whether the reference rests, and no window is being recorded.
    """
    if granted.answer is not None and _known(request, here) and request.serial == granted.newest:
        return Decided(granted, granted.answer)
    outcome = _judge(request, granted, settings, here, calm)
    answer = Answer(here.servo, here.boot, request.serial, here.sample, outcome, granted.newest)
    if outcome.passing or not _known(request, here) or outcome is Outcome.DUPLICATE:
        return Decided(granted, answer)
    granted = replace(
        granted, answer=Answer(here.servo, here.boot, request.serial, here.sample, outcome, request.serial)
    )
    granted = _grant(request, granted, settings, here) if outcome is Outcome.TAKEN else granted
    assert granted.answer is not None
    return Decided(granted, granted.answer)


def _known(request: Request, here: Instant) -> bool:
    """Whether it is for this edge as it runs."""
    return request.servo == here.servo and request.boot == here.boot


def _judge(request: Request, granted: Granted, settings: AgentSettings, here: Instant, calm: bool) -> Outcome:
    checks = (
        (request.servo == here.servo, Outcome.WRONG_SERVO),
        (request.boot == here.boot, Outcome.OTHER_BOOT),
        (request.serial > granted.newest, Outcome.DUPLICATE),
        (here.time < request.not_after, Outcome.EXPIRED),
    )
    outcome = next((outcome for passed, outcome in checks if not passed), Outcome.TAKEN)
    if outcome is not Outcome.TAKEN:
        return outcome
    if isinstance(request.ask, LongerWindow):
        return _judge_window(request.ask, settings)
    return _judge_probe(request.ask, granted, settings, here, calm)


def _judge_window(ask: LongerWindow, settings: AgentSettings) -> Outcome:
    longest, earliest = settings.longest_samples, settings.longest_pre_trigger_samples
    window, before = (round(seconds * settings.sample_rate) for seconds in (ask.window_s, ask.pre_trigger_s))
    return Outcome.TAKEN if window <= longest and before <= earliest else Outcome.TOO_LARGE


def _judge_probe(ask: Probe, granted: Granted, settings: AgentSettings, here: Instant, calm: bool) -> Outcome:
    limits = settings.probe
    if limits is None:
        return Outcome.NOT_ALLOWED
    move = ProbingMove.of(ask, here.sample, here.rate)
    checks = (
        (abs(ask.size) <= limits.size, Outcome.TOO_LARGE),
        (granted.pre_trigger + move.last - move.first <= settings.longest_samples, Outcome.TOO_LARGE),
        (_rested(granted, limits, here), Outcome.TOO_SOON),
        (calm and granted.probe is None, Outcome.BUSY),
    )
    return next((outcome for passed, outcome in checks if not passed), Outcome.TAKEN)


def _rested(granted: Granted, limits: ProbeLimits, here: Instant) -> bool:
    """Whether the last probing move is long enough ago."""
    return granted.probed is None or here.sample - granted.probed >= limits.interval_s * here.rate


def _grant(request: Request, granted: Granted, settings: AgentSettings, here: Instant) -> Granted:
    """Windows are at least as configured."""
    ask, rate = request.ask, settings.sample_rate
    if isinstance(ask, Probe):
        return replace(granted, probe=ProbingMove.of(ask, here.sample, rate), probed=here.sample)
    window, before = round(ask.window_s * rate), round(ask.pre_trigger_s * rate)
    window, before = max(window, settings.window_samples), max(before, settings.pre_trigger_samples)
    return replace(granted, window=window, pre_trigger=before)
