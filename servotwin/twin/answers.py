"""Steps of a twin for what is no window: acts, hellos, fallbacks, answers, wakes, verifications. Pure."""

from __future__ import annotations

import math
from typing import NamedTuple

from msgspec.structs import replace

from servotwin.errors import InvalidInput
from servotwin.messages import (
    Answer,
    Fallback,
    Hello,
    Message,
)
from servotwin.messages.acts import Act, ActKind
from servotwin.redesign.policy import Evidence, Redesign
from servotwin.twin.evidence import ActRecord, Record, VerificationRecord, WithdrawalRecord
from servotwin.twin.lookups import VerificationRequest
from servotwin.twin.model import TwinModel
from servotwin.twin.oversight import decide_act, sent_again
from servotwin.twin.state import TwinState, noted_setting

# Protocol from which on an edge sends a hello for every boot, and another where it is asked for windows of every boot.
_INTRODUCES_ITSELF = 2


class StepResult(NamedTuple):
    """Result of a step.

    Attributes
    ----------
    state : TwinState
    messages : tuple of Message
        Messages to the edge, in order.
    evidence : tuple of Record
        Evidence to store, in order; the caller passes a `VerificationRequest` among it as an event, at any later time.
    deferred : bool
        The window needs an estimate, and nothing else came of the step: the caller passes it again later.
    """

    state: TwinState
    messages: tuple[Message, ...] = ()
    evidence: tuple[Record, ...] = ()
    deferred: bool = False


def take_act(model: TwinModel, state: TwinState, act: Act, now: float) -> StepResult:
    """Carry out an engineer's act, and keep it with what became of it."""
    judged = decide_act(state.oversight, act, state.newest, state.known, model.policy)
    proposal, refused = judged.approved, judged.refused
    if proposal is not None and proposal.update.data_time <= state.versions.data_time:
        proposal, refused = None, "a newer version was sent meanwhile"
    record = ActRecord(act, refused)
    doubted = state.triage and state.triage.doubted(act.sentence)
    state = replace(state, oversight=judged.oversight, triage=doubted)
    if proposal is not None:
        versions = state.versions.with_update(proposal.update)
        state = replace(state, versions=versions, tuned_for=proposal.gap)
        update, verified = versions.pending, proposal.verification
        if update is None:
            return StepResult(state, (), (record,))
        evidence = (record, update) if verified is None else (record, update, replace(verified, version=update.version))
        return StepResult(state.with_sent(update, now), (update,), evidence)
    if act.act in (ActKind.HOLD, ActKind.ROLL_BACK) and not refused:
        # What was sent already may still be applied; it is not sent again, a probing move neither.
        requests = state.requests
        if requests is not None and requests.pending is not None:
            requests = requests.closed(None)
        state = replace(state, versions=state.versions.without_pending(), tuned_for=None, requests=requests)
    return StepResult(state, (), (record,))


def take_hello(state: TwinState, hello: Hello) -> StepResult:
    """Note that the edge started or reconnected, and its setting, which may come from an earlier boot."""
    versions = state.versions.noted(hello.boot, hello.parameter_version)
    if versions.has_ended(hello.boot):
        return StepResult(state, (), (hello,))
    known = noted_setting(state.known, hello.parameter_version, hello.setting, hello.parameter_version)
    introduced = hello.protocol >= _INTRODUCES_ITSELF
    return StepResult(replace(state, versions=versions, known=known, introduced=introduced), (), (hello,))


def take_fallback(state: TwinState, fallback: Fallback) -> StepResult:
    """Note that the edge has fallen back: no earlier update is sent again, and no proposal from before is approved."""
    versions = state.versions.noted(fallback.boot, fallback.parameter_version)
    if versions.has_ended(fallback.boot):
        return StepResult(state, (), (fallback,))
    state = replace(
        state,
        versions=versions.without_pending(),
        known=noted_setting(state.known, fallback.parameter_version, fallback.setting, fallback.replaced),
        tuned_for=None,
        triage=state.triage and state.triage.doubted("the edge has fallen back"),
        oversight=state.oversight.without_proposal(),
    )
    return StepResult(state, (), (fallback,))


def take_answer(model: TwinModel, state: TwinState, answer: Answer, now: float) -> StepResult:
    if model.requests is None or state.requests is None:
        return StepResult(state, (), (answer,))
    requests, again = model.requests.answered(state.requests, answer, now)
    state = replace(state, requests=requests)
    return StepResult(state, (), (answer,)) if again is None else StepResult(state, (again,), (answer, again))


def take_wake(model: TwinModel, state: TwinState, now: float) -> StepResult:
    """Repeat the pending update and request when their answers are overdue; abandon them after `attempts`."""
    repeated: tuple[Message, ...] = ()
    if model.requests is not None and state.requests is not None:
        requests, repeated = model.requests.wake(state.requests, now)
        state = replace(state, requests=requests)
    pending = state.versions.pending
    if pending is None or now < state.attempts.sent_at + model.settings.retry:
        return StepResult(state, repeated)
    if state.attempts.count >= model.settings.attempts:
        return StepResult(replace(state, versions=state.versions.without_pending()), repeated)
    return StepResult(replace(state, attempts=state.attempts.another(now)), (pending, *repeated))


def take_verification(model: TwinModel, state: TwinState, request: VerificationRequest) -> StepResult:
    """Verify a setting that was looked up; where that fails withdraw it, so that the fallback set is sent next."""
    if model.lookups is None or state.lookups is None:
        raise InvalidInput("no setting has to be verified, because the twin uses no table any more")
    current = [state.known.get(version) for version in state.versions.current]
    lookups, result, why = model.lookups.verify(state.lookups, request, current)
    record = VerificationRecord(request, result)
    if not why:
        return StepResult(replace(state, lookups=lookups), (), (record,))
    triage = state.triage and state.triage.doubted(why)
    versions, oversight = state.versions.without_pending(), state.oversight.without_proposal()
    state = replace(state, lookups=lookups, versions=versions, triage=triage, oversight=oversight)
    return StepResult(state, (), (record, WithdrawalRecord(request, why)))


def roll_back(model: TwinModel, state: TwinState, evidence: Evidence, act: Act) -> tuple[TwinState, Redesign]:
    """Carry out a roll back; the machine stays held."""
    state = replace(state, oversight=replace(state.oversight, again=None))
    try:
        redesign = sent_again(model.policy, evidence, act, state.known)
    except InvalidInput as error:
        return state, Redesign(None, math.nan, str(error))
    if state.lookups is not None and redesign.setting is not None:
        # The setting that failed its verification is replaced.
        state = replace(state, lookups=replace(state.lookups, why=""))
    return state, redesign
