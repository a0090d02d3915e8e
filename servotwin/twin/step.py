"""One step of a twin: model, state and an event in; the next state, messages and evidence out. Pure: no clock, no I/O.

The caller commits a window to the store before its step, and passes each window once. Windows may come in any order;
every one is estimated, but only one that is newer than all before changes the parameters, the trend and the starting
point of the next estimate. Only an estimate with the status OK changes the trend; an outlier does so only once others
agree with it.
With another status a policy may still use the window's input bias and noise, with the gap of the trend.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from msgspec.structs import replace

from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate
from servotwin.messages import (
    Answer,
    Fallback,
    Hello,
    InvalidMessage,
    LearntResponse,
    Message,
    ParameterMessage,
    Reason,
    Receipt,
    Update,
    WindowMessage,
    finite,
)
from servotwin.messages.acts import Act
from servotwin.redesign.policy import Evidence, Redesign
from servotwin.twin.answers import (
    StepResult,
    roll_back,
    take_act,
    take_answer,
    take_fallback,
    take_hello,
    take_verification,
    take_wake,
)
from servotwin.twin.asking import ask
from servotwin.twin.comparing import compare, not_as_stated
from servotwin.twin.estimating import OTHER_CONTROLLER, DecodedWindow, stated_machine
from servotwin.twin.evidence import (
    ActRecord,
    AlarmRecord,
    DisturbanceRecord,
    GapEstimateRecord,
    GlanceRecord,
    MachineRecord,
    MotorRecord,
    ProposalRecord,
    Record,
    RedesignRecord,
    TrendRecord,
)
from servotwin.twin.in_force import unless_in_force
from servotwin.twin.lookups import VerificationRequest
from servotwin.twin.model import TwinModel
from servotwin.twin.oversight import Proposal
from servotwin.twin.state import TwinState, draft_update
from servotwin.twin.triage import Glance, no_glance

_MIXED = "windows of two machines came under this name: a setting follows when some in a row are of one"
_BY_TURNS = "the gap falls and rises by turns: a setting follows when it has been one for some windows"
_OVERTAKEN = "a newer window of this servo has come: the setting follows from that"
_STALE = "the window is not newer than what the parameters stand on, or of an earlier boot"


# Windows whose input bias is remembered: enough to contain both directions of approach to a rest.
_RESTS = 3


class WindowArrival(NamedTuple):
    """A new window that the store has committed.

    Attributes
    ----------
    window : WindowMessage
    time : float
        Arrival, s, on the clock of `now`; the time between two boots of the edge is taken from it.
    overtaken : bool
        A newer window of the servo waits, or was processed already: this one changes no setting. With triage it gets a
        glance and no more.
    unseen : bool
        Other servos wait: without triage an overtaken window is not even estimated.
    too_late : str
        Reason why an update for this window could not be applied in time; empty: it could. It is estimated, and changes
        no setting.
    deferrable : bool
        Where a glance does not do, the window may be estimated later.
    """

    window: WindowMessage
    time: float
    overtaken: bool = False
    unseen: bool = False
    too_late: str = ""
    deferrable: bool = False


class Wake(NamedTuple):
    """Event: the time that `next_wake` returned has come."""


Event = WindowArrival | ParameterMessage | VerificationRequest | Act | Wake


def step(model: TwinModel, state: TwinState, event: Event, now: float) -> StepResult:
    """Process one event.

    Parameters
    ----------
    model : TwinModel
    state : TwinState
    event : WindowArrival, message, VerificationRequest, Act or Wake
    now : float
        Time on the twin's own clock, s. It may jump: no wait becomes longer than one that begins at `now`.

    Raises
    ------
    InvalidMessage
        The message is for another servo, or of a kind that only an edge receives.
    InvalidInput
        A verification is requested, but the twin uses no table any more.
    """
    if isinstance(event, VerificationRequest):
        return take_verification(model, state, event)
    if not isinstance(event, Wake):
        servo = event.window.servo if isinstance(event, WindowArrival) else event.servo
        if servo != state.servo:
            raise InvalidMessage(f"message of servo {servo!r} came to the twin of {state.servo!r}")
    # After a clock was set back, no retry may wait until it has caught up.
    requests = None if state.requests is None else state.requests.not_after(now)
    state = replace(state, attempts=state.attempts.not_after(now), requests=requests)
    match event:
        case WindowArrival():
            return _take_window(model, state, event, now)
        case Receipt():
            return _take_receipt(state, event, now)
        case Fallback():
            return take_fallback(state, event)
        case Hello():
            return take_hello(state, event)
        case Answer():
            return take_answer(model, state, event, now)
        case Act():
            return take_act(model, state, event, now)
        case Wake():
            return take_wake(model, state, now)
    raise InvalidMessage(f"a twin does not receive {type(event).__name__} messages")


def _take_receipt(state: TwinState, receipt: Receipt, now: float) -> StepResult:
    """Note what an edge did with an update; after a fallback the next window is worth an estimate in any case."""
    versions, again = state.versions.after_receipt(receipt)
    doubted = state.triage
    if state.triage is not None and receipt.reason in (Reason.FELL_BACK, Reason.AFTER_FALLBACK):
        doubted = state.triage.doubted(f"version {receipt.version} was refused: {receipt.reason.value}")
    return _send(replace(state, versions=versions, triage=doubted), again, now, (receipt,))


def next_wake(model: TwinModel, state: TwinState) -> float | None:
    """Time at which a `Wake` is due, s; None: no answer is pending."""
    update = None if state.versions.pending is None else state.attempts.sent_at + model.settings.retry
    request = None if model.requests is None or state.requests is None else model.requests.next_wake(state.requests)
    return min((due for due in (update, request) if due is not None), default=None)


class _Learnt(NamedTuple):
    """Estimate and disturbance of a window; the reason why no update may follow; True where it moves nothing."""

    estimate: GapEstimate
    disturbance: Disturbance
    rejection: str
    stale: bool


def _take_window(model: TwinModel, state: TwinState, event: WindowArrival, now: float) -> StepResult:
    """Glance at a window and, where that is not enough, work on it."""
    before, message, arrived = state, event.window, event.time
    if not state.is_of_other_boot(message):
        state = replace(state, versions=state.versions.noted(message.boot, message.parameter_version))
    decoded = DecodedWindow.of(message)
    state, glance = _glance(model, state, decoded, arrived)
    if state.oversight.again is not None and not event.overtaken:
        glance = None  # the setting that is sent again needs the window's estimate
    if glance is None and event.overtaken and event.unseen:
        glance = no_glance(_OVERTAKEN)
    if glance is not None and glance.moved and event.deferrable:
        return StepResult(before, deferred=True)
    if not state.has_overtaken(message):
        state = replace(state, newest=(message.boot, message.start))
    if glance is None:
        return _work_on(model, state, event, decoded, (), now)
    seen = (GlanceRecord(message, glance, decoded.tail),)
    if event.overtaken:
        return StepResult(state, (), seen)
    if glance.moved:
        return _work_on(model, state, event, decoded, seen, now)
    state, taught = _teach(model, state, decoded, arrived)
    return StepResult(state, taught, (*seen, *taught))


def _work_on(
    model: TwinModel, state: TwinState, event: WindowArrival, decoded: DecodedWindow, seen: Sequence[Record], now: float
) -> StepResult:
    """Estimate a window, redesign for it, and request more informative ones; `seen`: the record of its glance."""
    message, arrived, others = event.window, event.time, list[Message]()
    state, learnt, learnt_records = _learn(model, state, decoded, arrived)
    records = [*seen, *learnt_records]
    if not learnt.stale:
        state, taught = _teach(model, state, decoded, arrived, None if learnt.rejection else learnt.estimate)
        others, records = [*taught], [*records, *taught]
        state = state.with_step(decoded.step, decoded.way_to_rest)
    evidence = _evidence(model, state, learnt, arrived)
    if why_none := _OVERTAKEN if event.overtaken else event.too_late:
        redesign = Redesign(None, math.nan, why_none)
    else:
        again = state.oversight.again
        state, redesign = _redesign(model, state, evidence, learnt.stale)
        if again is not None and state.oversight.again is None:
            records.append(ActRecord(again, redesign.reason if redesign.setting is None else "", later=True))
    if learnt.disturbance.known and not learnt.stale and state.other_controller < OTHER_CONTROLLER:
        state = replace(state, rests=(*state.rests, learnt.disturbance.bias)[-_RESTS:])
    records.append(RedesignRecord(message, redesign))
    if not learnt.stale and not state.oversight.held:
        state, requested, decided = ask(model, state, message, learnt.estimate, arrived, now)
        others, records = [*others, *requested], [*records, *decided]
    result = _send_redesign(model, state, message, evidence, redesign, now)
    return result._replace(messages=(*result.messages, *others), evidence=(*records, *result.evidence))


def _send_redesign(
    model: TwinModel, state: TwinState, message: WindowMessage, evidence: Evidence, redesign: Redesign, now: float
) -> StepResult:
    """Send the setting of a redesign, or keep it as a proposal where an engineer is asked first."""
    if redesign.setting is None:
        return StepResult(state)
    draft, overseen = draft_update(message, evidence, redesign, model.settings.valid_for), state.oversight
    if overseen.ask_first and not overseen.held:
        if not overseen.proposes_anew(message):
            return StepResult(state)
        waiting = Proposal(draft, finite(redesign.gap), VerificationRequest.of(draft, redesign, evidence))
        return StepResult(replace(state, oversight=replace(overseen, proposal=waiting)), (), (ProposalRecord(waiting),))
    versions = state.versions.with_update(draft)
    state = replace(state, versions=versions, tuned_for=None if overseen.held else float(redesign.gap))
    assert versions.pending is not None
    unverified = VerificationRequest.of(versions.pending, redesign, evidence)
    sent = _send(state, versions.pending, now, ())
    return sent if unverified is None else sent._replace(evidence=(*sent.evidence, unverified))


def _learn(
    model: TwinModel, state: TwinState, decoded: DecodedWindow, arrived: float
) -> tuple[TwinState, _Learnt, list[Record]]:
    """Estimate a window and learn from it.

    A stale window is estimated for the record, but moves nothing: windows may come in any order.
    """
    message, trends, learning, before = decoded.message, model.settings.trend, model.settings.learning, state.wear
    expected = before.expect(trends, message.boot, message.middle, arrived, learning)
    estimate, disturbed = decoded.estimate(model.estimator, expected), decoded.disturbance(model.observer)
    stale, rejection = not state.versions.admits(message), _STALE
    if not stale:
        stated, window = stated_machine(model.settings), decoded.window
        wear, rejection = before.update(trends, message.boot, estimate, arrived, learning, stated, window, model.motor)
        state = replace(state, wear=wear)
    after = state.wear
    trend = after.trend(trends)
    if model.triage is not None and state.triage is not None and not stale:
        known = after.known_machine(learning, arrived)
        triage = model.triage.estimated(state.triage, message, decoded.window, estimate, trend, rejection, known)
        state = replace(state, triage=triage)
    records: list[Record] = [
        GapEstimateRecord(message, estimate, expected, decoded.tail),
        DisturbanceRecord(message, disturbed),
        TrendRecord(message, trend),
    ]
    if after.machine is not None and after.machine != before.machine:
        records.append(MachineRecord(message, after.machine))
    if after.motor is not None and after.motor != before.motor:
        records.append(MotorRecord(message, after.motor))
    records += [
        AlarmRecord(message, sentence) for sentence in after.alarms(before, estimate, trends, learning, model.motor)
    ]
    if not stale:
        state, differs = compare(model, state, decoded)
        records += [AlarmRecord(message, sentence) for sentence in differs]
    return state, _Learnt(estimate, disturbed, rejection, stale), records


def _evidence(model: TwinModel, state: TwinState, learnt: _Learnt, arrived: float) -> Evidence:
    """Make what the policy is consulted with."""
    wear, learning = state.wear, model.settings.learning
    return Evidence(
        learnt.estimate,
        learnt.disturbance,
        wear.trend(model.settings.trend),
        state.known.get(state.versions.in_force),
        state.tuned_for,
        learnt.rejection,
        None if wear.machine is None else wear.machine.prior(learning, arrived),
        None if model.motor is None else model.motor.current(wear.motor, arrived),
        state.rests,
        state.usual_steps,
        state.search,
    )


def _glance(
    model: TwinModel, state: TwinState, decoded: DecodedWindow, arrived: float
) -> tuple[TwinState, Glance | None]:
    """Glance at a window that arrived at a time (s); None: without triage, or not possible."""
    if model.triage is None or state.triage is None or decoded.window is None:
        return state, None
    requested = state.requests is not None and state.requests.pending is not None
    trend = state.wear.trend(model.settings.trend)
    machine = state.wear.known_machine(model.settings.learning, arrived)
    triage, glance = model.triage.glance(state.triage, decoded.message, decoded.window, trend, requested, machine)
    return replace(state, triage=triage), glance


def _teach(
    model: TwinModel, state: TwinState, decoded: DecodedWindow, arrived: float, estimate: GapEstimate | None = None
) -> tuple[TwinState, tuple[LearntResponse, ...]]:
    """Decide if the edge is sent the learnt structure; `estimate`: of this window, where it counts."""
    if model.responses is None or state.responses is None or state.oversight.held:
        return state, ()
    machine = None if estimate is None else state.wear.known_machine(model.settings.learning, arrived)
    responses, sent = model.responses.after(state.responses, decoded, arrived, estimate, machine)
    return replace(state, responses=responses), () if sent is None else (sent,)


def _redesign(model: TwinModel, state: TwinState, evidence: Evidence, stale: bool) -> tuple[TwinState, Redesign]:
    """Consult the policy; without a setting the result has the reason."""
    machine, overseen = state.wear.machine, state.oversight
    if overseen.again is not None and overseen.again.version is None and not stale:
        # The fallback set is for every machine within the stated ranges, in doubt too.
        return roll_back(model, state, evidence, overseen.again)
    if machine is not None and machine.disputed and not stale:
        return state, Redesign(None, math.nan, machine.alarm or _MIXED)
    if state.wear.by_turns and not stale:
        return state, Redesign(None, math.nan, _BY_TURNS)
    if (other := not_as_stated(state)) and not stale:
        return state, Redesign(None, math.nan, other)
    needs_estimate = model.lookups is None and model.policy.needs_estimate
    if stale:
        return state, Redesign(None, math.nan, evidence.why_not)
    if overseen.again is not None:
        return roll_back(model, state, evidence, overseen.again)
    if overseen.held:
        return state, Redesign(None, math.nan, _why_held(state))
    if evidence.why_not and needs_estimate:
        return state, Redesign(None, math.nan, evidence.why_not)
    try:
        if model.lookups is None or state.lookups is None:
            lookups, redesign = state.lookups, model.policy.redesign(evidence)
        else:
            lookups, redesign = model.lookups.redesign(state.lookups, evidence)
        state = replace(state, lookups=lookups, search=redesign.search or state.search)
        return state, unless_in_force(state, evidence, redesign)
    except InvalidInput as error:
        return state, Redesign(None, math.nan, str(error))


def _why_held(state: TwinState) -> str:
    """Say who holds the machine; and that what is in force there failed, for a hold keeps it."""
    failed = "" if state.lookups is None else state.lookups.why
    held = state.oversight.held
    return f"{held}; but {failed}: roll back to the fallback set" if failed else held


def _send(state: TwinState, update: Update | None, now: float, records: tuple[Record, ...]) -> StepResult:
    """Send the pending update for the first time; None: there is none."""
    if update is None:
        return StepResult(state, (), records)
    return StepResult(state.with_sent(update, now), (update,), (*records, update))
