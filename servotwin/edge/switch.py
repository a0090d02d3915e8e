"""When parameters change: an admissible update waits for a safe instant, the fallback set does not. Pure.

A change of the dead zone is safe while the error is smaller than every threshold, old and new, or larger than every one
of them: the loop is open before and after, or closed before and after. Gains change at any instant, since
`servotwin.control.law.transfer` leaves the voltage where it is. What still waits after `Limits.patience_s` is applied
wherever the error is: the voltage does not jump even then, while a loop that rests near its threshold would otherwise
never get the setting that was proved for it.

One update waits at a time. A newer one that may be applied takes its place; the older one is refused. Before it is
applied an update is judged once more: what expired meanwhile is refused.

The fallback set gets a version of its own, so that every update on its way to the version it replaced is refused, as is
every update that stands on data from before. After a second fallback, updates are refused for twice as long, and so on.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import msgspec

from servotwin.control.controller import Controller
from servotwin.control.gains import gains_of, with_gains
from servotwin.edge.guard import Instant, applied, judge, receipt, repeats
from servotwin.edge.limits import Limits
from servotwin.edge.parameters import Parameters
from servotwin.edge.verdict import FallbackSet, Verdict
from servotwin.messages import Cause, Fallback, Gains, Reason, Receipt, Setting, Update

MOST_DOUBLINGS = 6
REFUSED_S = 10.0
"""No update is taken so long after a drive has refused one, twice as long after the next."""


@dataclass(frozen=True, slots=True)
class Rules:
    """What stays the same while parameters change.

    Parameters
    ----------
    limits : Limits
    controller : Controller, optional
        As configured: what updates do not change. None: the edge knows of no gains and of no thresholds.
    own : Gains, optional
        The servo's own gains, in the middle of the box; None: the controller's.
    """

    limits: Limits
    controller: Controller | None = None
    own: Gains | None = None

    @property
    def centre(self) -> Gains | None:
        """The middle of the box; None: no gains are accepted."""
        return self.own if self.own is not None or self.controller is None else gains_of(self.controller)


@dataclass(frozen=True, slots=True)
class Waiting:
    """An admissible update, and the sample at which it came."""

    update: Update
    since: int


@dataclass(frozen=True, slots=True)
class Switch:
    """What is in force, what waits, and how often the edge fell back."""

    current: Parameters
    waiting: Waiting | None = None
    fallbacks: int = 0


class Step(NamedTuple):
    """The state after a decision, and what the twin is told."""

    state: Switch
    said: tuple[Receipt | Fallback, ...] = ()


def offer(state: Switch, update: Update, rules: Rules, here: Instant, error: float | None) -> Step:
    """Take an update: applied at once, kept for a safe instant, or refused.

    Parameters
    ----------
    error : float, optional
        Last tracking error, m; None: there was no sample yet.
    """
    current, waiting = state.current, state.waiting
    if repeats(update, current, here):
        return Step(state, (receipt(update, Reason.APPLIED, current.sample, current, here),))
    if waiting is not None and update == waiting.update:
        return Step(state)
    reason = _judge_beside(update, state, rules, here)
    if reason is not Reason.APPLIED:
        return Step(state, (receipt(update, reason, here.sample, current, here),))
    refused = () if waiting is None else (receipt(waiting.update, Reason.SUPERSEDED, here.sample, current, here),)
    after = settle(replace(state, waiting=Waiting(update, here.sample)), rules, here, error)
    return Step(after.state, refused + after.said)


def settle(state: Switch, rules: Rules, here: Instant, error: float | None) -> Step:
    """Apply what waits if this is a safe instant or its patience is over; refuse what expired."""
    waiting = state.waiting
    if waiting is None:
        return Step(state)
    update, current = waiting.update, state.current
    reason = judge(update, current, rules.limits, here, rules.centre)
    after = applied(update, current, here.sample)
    if reason is not Reason.APPLIED:
        return Step(replace(state, waiting=None), (receipt(update, reason, here.sample, current, here),))
    patient = here.sample - waiting.since < rules.limits.patience_s * here.rate
    if patient and not is_safe(current, after, rules.controller, error):
        return Step(state)
    told = receipt(update, Reason.APPLIED, here.sample, after, here)
    return Step(replace(state, current=after, waiting=None), (told,))


def fall_back(state: Switch, fallback: FallbackSet, verdict: Verdict, here: Instant) -> Step:
    """The fallback set at the next sample, whatever the error is; what waits is refused."""
    setting = msgspec.structs.replace(fallback.setting, gains=fallback.setting.gains or state.current.setting.gains)
    new = Parameters(0, setting, here.time, fallback=True)
    return _leave(state, new, fallback.setting.gains, verdict, fallback.refuse_s, here)


def restore(state: Switch, former: Parameters, here: Instant) -> Step:
    """What the drive runs on, as it does not take what is in force; what waits is refused."""
    new = replace(former, data_time=here.time, window=None)
    return _leave(state, new, former.setting.gains, Verdict(Cause.DRIVE, 0.0, 0.0), REFUSED_S, here)


def _leave(
    state: Switch, new: Parameters, gains: Gains | None, verdict: Verdict, refuse_s: float, here: Instant
) -> Step:
    """Other parameters at the next sample, under a version of their own, and no updates for a while."""
    old, waiting = state.current, state.waiting
    version = 1 + max(old.version, 0 if waiting is None else waiting.update.version)
    not_before = here.sample + round(refuse_s * 2.0 ** min(state.fallbacks, MOST_DOUBLINGS) * here.rate)
    new = replace(new, version=version, sample=here.sample, not_before=not_before)
    told = Fallback(
        here.servo, here.boot, here.sample, *verdict, old.version, version, Setting(new.setting.tolerance, gains)
    )
    refused = () if waiting is None else (receipt(waiting.update, Reason.AFTER_FALLBACK, here.sample, new, here),)
    return Step(Switch(new, None, state.fallbacks + 1), (*refused, told))


def is_safe(old: Parameters, new: Parameters, controller: Controller | None, error: float | None) -> bool:
    """Whether the change neither opens nor closes the loop: see the module's text.

    Parameters
    ----------
    old, new : Parameters
    controller : Controller, optional
        For the thresholds; None: they are the tolerances.
    error : float, optional
        m; None: there was no sample yet, nothing can jump.
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


def _judge_beside(update: Update, state: Switch, rules: Rules, here: Instant) -> Reason:
    """As the guard judges, and newer than what waits."""
    reason = judge(update, state.current, rules.limits, here, rules.centre)
    if reason is not Reason.APPLIED or state.waiting is None:
        return reason
    kept = state.waiting.update
    if update.version <= kept.version:
        return Reason.OLD_VERSION
    return Reason.APPLIED if update.data_time > kept.data_time else Reason.OLD_DATA
