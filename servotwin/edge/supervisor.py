"""Supervisor of the parameters in force, and the switch between them.

The switch is made of pure functions: an admissible update waits for a safe instant, the fallback set does not. The
supervisor joins it with the watch, the twin's silence and the parameter store. It checks at multiples of its period,
and only when there is something to check; so its decisions are the same whether samples come one by one or in blocks.

A change of the dead zone is safe while the error is smaller than every threshold, old and new, or larger than every one
of them: the loop is open before and after, or closed before and after. Gains change at any instant, since
`servotwin.control.law.transfer` leaves the voltage where it is. An update that still waits after `Limits.patience_s` is
applied wherever the error is: the voltage does not jump even then. Without this a loop that rests near its threshold
would never get the setting that was verified for it.

One update is pending at a time. A newer one that may be applied takes its place; the older one is refused. Before it is
applied an update is judged once more, and refused where it has expired.

The fallback set gets a version of its own. So every update in flight is refused whose base is the version it replaced,
or whose data are from before the fallback: the twin, which may have given the same number to an update meanwhile, reads
in the receipt that the edge fell back. After each further fallback, updates are refused for twice as long.
"""

from dataclasses import dataclass, replace
from math import ceil, inf
from typing import NamedTuple

from servotwin.config.own_units import VOLTS_METRES, OwnUnits
from servotwin.control.gains import gains_of, holds, key_of, with_gains
from servotwin.control.laws import AnyController, law_of
from servotwin.edge.guard import Instant, Limits, is_repeat, judge, receipt, updated_parameters
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.recorder import Recorder
from servotwin.edge.settings import AgentSettings
from servotwin.edge.store import ParameterStore
from servotwin.edge.watch import Violation, Watch
from servotwin.messages import AnyGains, Cause, Fallback, Reason, Receipt, Setting, Update

_MOST_DOUBLINGS = 6
_REFUSE_AFTER_DRIVE_S = 10.0
"""Time for which updates are refused after a drive has refused one; twice as long after the next."""


@dataclass(frozen=True, slots=True)
class Rules:
    """Settings of the switch.

    Parameters
    ----------
    limits : Limits
    controller : Controller, Cascade or LinearLaw, optional
        Configured controller, with the limits that updates do not change. None: the edge knows no gains or thresholds.
    own : gains, optional
        The servo's own gains; None: the controller's.
    units : OwnUnits
        Of the machine.
    """

    limits: Limits
    controller: AnyController | None = None
    own: AnyGains | None = None
    units: OwnUnits = VOLTS_METRES

    @property
    def centre(self) -> AnyGains | None:
        """Gains from which the limits count; None: no gains are accepted."""
        return self.own if self.own is not None or self.controller is None else gains_of(self.controller)

    def detail(self, update: Update, reason: Reason) -> str:
        """The number of a refused update that is out of bounds, and what is allowed; empty: the reason says it all."""
        gains, own, law = update.setting.gains, self.centre, self.controller
        if reason is not Reason.GAINS_OUT_OF_BOUNDS or gains is None or own is None or type(gains) is not type(own):
            return ""
        found = self.limits.out_of_bounds(gains, own)
        if found is None:
            return ""
        name = found.name if law is None else self.units.key(key_of(law, found.name))
        return f"{name} = {found.value:.9g}: must be within {found.least:.9g} and {found.greatest:.9g}"


@dataclass(frozen=True, slots=True)
class PendingUpdate:
    """An admissible update, and the sample at which it arrived."""

    update: Update
    since: int


@dataclass(frozen=True, slots=True)
class Switch:
    """State of the switch: parameters in force, the pending update, and the number of fallbacks so far.

    With `superseded` another edge of the servo has taken over, and no update is applied any more.
    """

    current: Parameters
    pending: PendingUpdate | None = None
    fallbacks: int = 0
    superseded: bool = False


class Transition(NamedTuple):
    """State after a decision, and the messages to the twin."""

    state: Switch
    messages: tuple[Receipt | Fallback, ...] = ()


def offer(state: Switch, update: Update, rules: Rules, here: Instant, error: float | None) -> Transition:
    """Decide about an update: apply it, let it wait for a safe instant, or refuse it.

    Parameters
    ----------
    error : float, optional
        Last tracking error, m; None: there was no sample yet.
    """
    current, pending = state.current, state.pending
    # Its receipt was lost: the twin gets the same answer again.
    if is_repeat(update, current, here):
        return Transition(state, (receipt(update, Reason.APPLIED, current.sample, current, here),))
    # Repeated while it waits: the receipt follows the decision.
    if pending is not None and update == pending.update:
        return Transition(state)
    reason = _judge_with_pending(update, state, rules, here)
    if reason is not Reason.APPLIED:
        return Transition(state, (receipt(update, reason, here.sample, current, here, rules.detail(update, reason)),))
    refused = () if pending is None else (receipt(pending.update, Reason.SUPERSEDED, here.sample, current, here),)
    after = apply_pending(replace(state, pending=PendingUpdate(update, here.sample)), rules, here, error)
    return Transition(after.state, refused + after.messages)


def apply_pending(state: Switch, rules: Rules, here: Instant, error: float | None) -> Transition:
    """Apply the pending update at a safe instant or when its patience is over; refuse it where it has expired."""
    pending = state.pending
    if pending is None:
        return Transition(state)
    update, current = pending.update, state.current
    reason = _judge(update, current, rules, here)
    after = updated_parameters(update, current, here.sample)
    if reason is not Reason.APPLIED:
        answer = receipt(update, reason, here.sample, current, here, rules.detail(update, reason))
        return Transition(replace(state, pending=None), (answer,))
    patient = here.sample - pending.since < rules.limits.patience_s * here.rate
    if patient and not is_safe(current, after, rules.controller, error):
        return Transition(state)
    message = receipt(update, Reason.APPLIED, here.sample, after, here)
    return Transition(replace(state, current=after, pending=None), (message,))


def fall_back(state: Switch, fallback: FallbackSet, violation: Violation, here: Instant) -> Transition:
    """Put the fallback set in force at the next sample, whatever the error is; refuse the pending update."""
    setting = fallback.setting.with_gains(fallback.setting.gains or state.current.setting.gains)
    # Data time now: updates from data recorded before the fallback are refused.
    new = Parameters(0, setting, here.time, fallback=True)
    return _replace(state, new, fallback.setting.gains, violation, fallback.refuse_s, here)


def restore(state: Switch, former: Parameters, here: Instant) -> Transition:
    """Put former parameters in force again, since the drive has refused the present ones; refuse the pending update."""
    new = replace(former, data_time=here.time, window=None)
    return _replace(state, new, former.setting.gains, Violation(Cause.DRIVE, 0.0, 0.0), _REFUSE_AFTER_DRIVE_S, here)


def supersede(state: Switch, fallback: FallbackSet | None, here: Instant) -> Transition:
    """Fall back where there is a fallback set, and refuse every update: they are for the edge that has taken over."""
    state = replace(state, superseded=True)
    if fallback is not None and not state.current.fallback:
        return fall_back(state, fallback, Violation(Cause.CONFLICT, 0.0, 0.0), here)
    return Transition(replace(state, pending=None), _refused_pending(state, Reason.TAKEN_OVER, state.current, here))


def _refused_pending(state: Switch, reason: Reason, current: Parameters, here: Instant) -> tuple[Receipt, ...]:
    if state.pending is None:
        return ()
    return (receipt(state.pending.update, reason, here.sample, current, here),)


def _replace(
    state: Switch, new: Parameters, gains: AnyGains | None, violation: Violation, refuse_s: float, here: Instant
) -> Transition:
    """Put other parameters in force at the next sample, under a new version, and refuse updates for a while."""
    old, pending = state.current, state.pending
    # Above the pending version too, which the twin has already used.
    version = 1 + max(old.version, 0 if pending is None else pending.update.version)
    not_before = here.sample + round(refuse_s * 2.0 ** min(state.fallbacks, _MOST_DOUBLINGS) * here.rate)
    new = replace(new, version=version, sample=here.sample, not_before=not_before)
    message = Fallback(
        here.servo, here.boot, here.sample, *violation, old.version, version, Setting.of(new.setting.tolerance, gains)
    )
    after = replace(state, current=new, pending=None, fallbacks=state.fallbacks + 1)
    return Transition(after, (*_refused_pending(state, Reason.FELL_BACK, new, here), message))


def is_safe(old: Parameters, new: Parameters, controller: AnyController | None, error: float | None) -> bool:
    """True where the change of the dead zone neither opens nor closes the loop (see the module).

    Parameters
    ----------
    old, new : Parameters
    controller : Controller, Cascade or LinearLaw, optional
        Gives the thresholds; None: they are the tolerances.
    error : float, optional
        Last tracking error, m; None: there was no sample yet, so nothing can jump.
    """
    before, after = _thresholds(old, controller), _thresholds(new, controller)
    if before == after or error is None:
        return True
    low, high = min(before[0], after[0]), max(before[1], after[1])
    return abs(error) < low or abs(error) > high


def _thresholds(parameters: Parameters, controller: AnyController | None) -> tuple[float, float]:
    if controller is None:
        return parameters.setting.tolerance, parameters.setting.tolerance
    return law_of(with_gains(controller, parameters.setting.gains)).thresholds(parameters.setting.tolerance)


def _judge(update: Update, current: Parameters, rules: Rules, here: Instant) -> Reason:
    """Judge as the guard does, and refuse gains of which the controller cannot be made."""
    reason = judge(update, current, rules.limits, here, rules.centre)
    if reason is Reason.APPLIED and rules.controller is not None and not holds(rules.controller, update.setting.gains):
        return Reason.GAINS_OUT_OF_BOUNDS
    return reason


def _judge_with_pending(update: Update, state: Switch, rules: Rules, here: Instant) -> Reason:
    """Judge as `_judge` does, and refuse one that is not newer than the pending one, or is for another edge."""
    if state.superseded:
        return Reason.TAKEN_OVER
    reason = _judge(update, state.current, rules, here)
    if reason is not Reason.APPLIED or state.pending is None:
        return reason
    other = state.pending.update
    if update.version <= other.version:
        return Reason.OLD_VERSION
    return Reason.APPLIED if update.data_time > other.data_time else Reason.OLD_DATA


Messages = tuple[Receipt | Fallback, ...]


class Supervisor:
    """Decides about parameters; the agent reports updates, windows sent, and answers of the twin.

    Parameters
    ----------
    settings : AgentSettings
    recorder : Recorder
        Samples of the agent.
    store : ParameterStore, optional
        Its parameters, where it has some, replace the configured ones.
    """

    def __init__(self, settings: AgentSettings, recorder: Recorder, store: ParameterStore | None = None) -> None:
        self._settings, self._recorder, self._store = settings, recorder, store
        self._rules = Rules(settings.limits, settings.controller, settings.own, settings.units)
        self._state = Switch(self._first_parameters())
        self._fallback = settings.supervision.fallback
        self._watch = self._new_watch()
        self._unanswered_since: float | None = None
        self._saved = True

    @property
    def parameters(self) -> Parameters:
        """Parameters in force from the next sample on."""
        return self._state.current

    @property
    def next_check(self) -> float:
        """Number of samples at which it checks next; inf: nothing to check."""
        period, samples = self._settings.period_samples, self._recorder.samples
        next_one = (samples // period + 1) * period
        if self._watching or self._state.pending is not None:
            return next_one
        if (
            self._unanswered_since is None
            or self._fallback is None
            or self._fallback.silence_s == inf
            or self.parameters.fallback
        ):
            return inf
        late = (self._unanswered_since + self._fallback.silence_s) * self._settings.sample_rate
        return max(next_one, ceil(late / period - 1e-9) * period)  # 1e-9: rounding of a time that is a multiple

    def offer(self, update: Update) -> Messages:
        """Take an update from the twin."""
        return self._advance(offer(self._state, update, self._rules, self._here, self._error))

    def restore(self, former: Parameters) -> Messages:
        """Put former parameters in force again, since the drive has refused the present ones."""
        return self._advance(restore(self._state, former, self._here))

    def superseded(self) -> Messages:
        """Fall back where there is a fallback set, since another edge of the servo has taken over; take no updates."""
        return self._advance(supersede(self._state, self._fallback, self._here))

    def window_sent(self, now: float) -> None:
        """Note that a window is on its way to the twin."""
        self._unanswered_since = now if self._unanswered_since is None else self._unanswered_since

    def twin_answered(self, now: float, more: bool) -> None:
        """Note an answer of the twin's; `more` windows may still wait for theirs."""
        # While other windows wait, the silence counts from this answer.
        self._unanswered_since = now if more else None

    def check(self) -> Messages:
        """Check the loop and the twin, if a check is due at this sample."""
        if self._recorder.samples % self._settings.period_samples != 0:
            return ()
        violation = self._violation()
        if violation is not None and self._fallback is not None:
            return self._advance(fall_back(self._state, self._fallback, violation, self._here))
        self._store_verified()
        return self._advance(apply_pending(self._state, self._rules, self._here, self._error))

    @property
    def _watching(self) -> bool:
        return self._watch is not None and not self.parameters.fallback

    @property
    def _here(self) -> Instant:
        s = self._settings
        return Instant(s.servo, s.boot, self._recorder.samples, s.sample_rate)

    @property
    def _error(self) -> float | None:
        samples = self._recorder.samples
        if samples == 0:
            return None
        last = self._recorder.cut(samples - 1, samples)
        return last["reference"][0] - last["position"][0]

    def _first_parameters(self) -> Parameters:
        """Parameters stored by the last boot, otherwise the configured ones; gains of another law do not count."""
        stored = None if self._store is None else self._store.load()
        first, controller = self._settings.parameters if stored is None else stored, self._settings.controller
        if controller is not None and (first.setting.gains is None or not holds(controller, first.setting.gains)):
            return replace(first, setting=first.setting.with_gains(gains_of(controller)))
        return first

    def _new_watch(self) -> Watch | None:
        s = self._settings
        if self._fallback is None or s.supervision.watch is None:
            return None
        watch = Watch(s.supervision.watch, s.sample_rate, s.reference, self._fallback.setting.band)
        watch.restart(self.parameters.setting.band, 0)
        return watch

    def _advance(self, transition: Transition) -> Messages:
        """Take over the state after a decision, and return its messages."""
        before, self._state = self._state, transition.state
        if self._state.current is not before.current:
            self._saved = False
            if self._watch is not None:
                self._watch.restart(self.parameters.setting.band, self.parameters.sample)
            self._store_verified()
        return transition.messages

    def _store_verified(self) -> None:
        """Store the parameters in force once the loop has kept their band; the fallback set at once."""
        if self._store is None or self._saved:
            return
        if not self._watching or (self._watch is not None and self._watch.verified):
            self._store.save(self.parameters)
            self._saved = True

    def _violation(self) -> Violation | None:
        """Evidence against the parameters in force; never against the fallback set, which nothing can replace."""
        if self._fallback is None or self.parameters.fallback:
            return None
        return self._watch_loop() or self._silence()

    def _watch_loop(self) -> Violation | None:
        if self._watch is None:
            return None
        last = self._recorder.samples
        first = last - self._settings.period_samples
        part = self._recorder.cut(first, last)
        return self._watch.update(first, part["reference"], part["position"], part["voltage"])

    def _silence(self) -> Violation | None:
        if self._fallback is None or self._unanswered_since is None:
            return None
        waited, allowed = self._here.time - self._unanswered_since, self._fallback.silence_s
        return Violation(Cause.SILENCE, waited, allowed) if waited >= allowed else None
