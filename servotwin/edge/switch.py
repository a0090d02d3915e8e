"""Switch of parameters: an admissible update waits for a safe instant, the fallback set does not. Pure functions.

A change of the dead zone is safe while the error is smaller than every threshold, old and new, or larger than every one
of them: the loop is open before and after, or closed before and after. Gains change at any instant, since
`servotwin.control.law.transfer` leaves the voltage where it is. An update that still waits after `Limits.patience_s` is
applied wherever the error is: the voltage does not jump even then. Without this a loop that rests near its threshold
would never get the setting that was verified for it.

One update is pending at a time. A newer one that may be applied takes its place; the older one is refused. Before it is
applied an update is judged once more, and refused where it has expired.

The fallback set gets a version of its own. So every update in flight is refused whose base is the version it replaced,
or whose data are from before the fallback. After each further fallback, updates are refused for twice as long.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import msgspec

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of, with_gains
from servotwin.edge.guard import Instant, is_repeat, judge, receipt, updated_parameters
from servotwin.edge.limits import Limits
from servotwin.edge.parameters import FallbackSet, Parameters
from servotwin.edge.watch import Violation
from servotwin.messages import Cause, Fallback, Gains, Reason, Receipt, Setting, Update

_MOST_DOUBLINGS = 6
_REFUSE_AFTER_DRIVE_S = 10.0
"""Time for which updates are refused after a drive has refused one; twice as long after the next."""


@dataclass(frozen=True, slots=True)
class Rules:
    """Settings of the switch.

    Parameters
    ----------
    limits : Limits
    controller : Controller, optional
        Configured controller, with the limits that updates do not change. None: the edge knows no gains or thresholds.
    own : Gains, optional
        The servo's own gains, in the middle of the box; None: the controller's.
    """

    limits: Limits
    controller: Controller | None = None
    own: Gains | None = None

    @property
    def centre(self) -> Gains | None:
        """Gains in the middle of the allowed box; None: no gains are accepted."""
        return self.own if self.own is not None or self.controller is None else gains_of(self.controller)


@dataclass(frozen=True, slots=True)
class PendingUpdate:
    """An admissible update, and the sample at which it arrived."""

    update: Update
    since: int


@dataclass(frozen=True, slots=True)
class Switch:
    """State of the switch: parameters in force, the pending update, and the number of fallbacks so far."""

    current: Parameters
    pending: PendingUpdate | None = None
    fallbacks: int = 0


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
    if is_repeat(update, current, here):
        return Transition(state, (receipt(update, Reason.APPLIED, current.sample, current, here),))
    if pending is not None and update == pending.update:
        return Transition(state)
    reason = _judge_with_pending(update, state, rules, here)
    if reason is not Reason.APPLIED:
        return Transition(state, (receipt(update, reason, here.sample, current, here),))
    refused = () if pending is None else (receipt(pending.update, Reason.SUPERSEDED, here.sample, current, here),)
    after = apply_pending(replace(state, pending=PendingUpdate(update, here.sample)), rules, here, error)
    return Transition(after.state, refused + after.messages)


def apply_pending(state: Switch, rules: Rules, here: Instant, error: float | None) -> Transition:
    """Apply the pending update at a safe instant or when its patience is over; refuse it where it has expired."""
    pending = state.pending
    if pending is None:
        return Transition(state)
    update, current = pending.update, state.current
    reason = judge(update, current, rules.limits, here, rules.centre)
    after = updated_parameters(update, current, here.sample)
    if reason is not Reason.APPLIED:
        return Transition(replace(state, pending=None), (receipt(update, reason, here.sample, current, here),))
    patient = here.sample - pending.since < rules.limits.patience_s * here.rate
    if patient and not is_safe(current, after, rules.controller, error):
        return Transition(state)
    message = receipt(update, Reason.APPLIED, here.sample, after, here)
    return Transition(replace(state, current=after, pending=None), (message,))


def fall_back(state: Switch, fallback: FallbackSet, violation: Violation, here: Instant) -> Transition:
    """Put the fallback set in force at the next sample, whatever the error is; refuse the pending update."""
    setting = msgspec.structs.replace(fallback.setting, gains=fallback.setting.gains or state.current.setting.gains)
    new = Parameters(0, setting, here.time, fallback=True)
    return _replace(state, new, fallback.setting.gains, violation, fallback.refuse_s, here)


def restore(state: Switch, former: Parameters, here: Instant) -> Transition:
    """Put former parameters in force again, since the drive has refused the present ones; refuse the pending update."""
    new = replace(former, data_time=here.time, window=None)
    return _replace(state, new, former.setting.gains, Violation(Cause.DRIVE, 0.0, 0.0), _REFUSE_AFTER_DRIVE_S, here)


def _replace(
    state: Switch, new: Parameters, gains: Gains | None, violation: Violation, refuse_s: float, here: Instant
) -> Transition:
    """Put other parameters in force at the next sample, under a new version, and refuse updates for a while."""
    old, pending = state.current, state.pending
    version = 1 + max(old.version, 0 if pending is None else pending.update.version)
    not_before = here.sample + round(refuse_s * 2.0 ** min(state.fallbacks, _MOST_DOUBLINGS) * here.rate)
    new = replace(new, version=version, sample=here.sample, not_before=not_before)
    message = Fallback(
        here.servo, here.boot, here.sample, *violation, old.version, version, Setting(new.setting.tolerance, gains)
    )
    refused = () if pending is None else (receipt(pending.update, Reason.AFTER_FALLBACK, here.sample, new, here),)
    return Transition(Switch(new, None, state.fallbacks + 1), (*refused, message))


def is_safe(old: Parameters, new: Parameters, controller: Controller | None, error: float | None) -> bool:
    """True where the change of the dead zone neither opens nor closes the loop (see the module).

    Parameters
    ----------
    old, new : Parameters
    controller : Controller, optional
        Gives the thresholds; None: they are the tolerances.
    error : float, optional
        Last tracking error, m; None: there was no sample yet, so nothing can jump.
    """
    before, after = _thresholds(old, controller), _thresholds(new, controller)
    if before == after or error is None:
        return True
    low, high = min(before[0], after[0]), max(before[1], after[1])
    return abs(error) < low or abs(error) > high


def _thresholds(parameters: Parameters, controller: Controller | None) -> tuple[float, float]:
    if controller is None:
        return parameters.setting.tolerance, parameters.setting.tolerance
    return with_gains(controller, parameters.setting.gains).thresholds(parameters.setting.tolerance)


def _judge_with_pending(update: Update, state: Switch, rules: Rules, here: Instant) -> Reason:
    """Judge as the guard does, and refuse an update that is not newer than the pending one."""
    reason = judge(update, state.current, rules.limits, here, rules.centre)
    if reason is not Reason.APPLIED or state.pending is None:
        return reason
    other = state.pending.update
    if update.version <= other.version:
        return Reason.OLD_VERSION
    return Reason.APPLIED if update.data_time > other.data_time else Reason.OLD_DATA
