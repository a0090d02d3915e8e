"""Excitation: requests for longer windows where windows are uninformative, and only then for a probing move.

The calmer a loop, the less informative its windows (dual control). A longer window costs only bytes; a move of the
reference disturbs the machine, so the policy requests it only where the configuration allows it, no larger than needed,
and rarely. Windows that do not tell the gap from the ratio of a rigid screw lead to a probing move at once, of moves of
different lengths. The policy is a pure function of its state and one window; every decision carries its reason.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, NamedTuple

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import check, key, settings
from servotwin.estimation.estimate import GapStatus, UnknownRatio
from servotwin.messages import Ask, LongerWindow, Probe, RequestOutcome
from servotwin.plant.display_units import MILLIMETRES, DisplayUnit

_ROUNDING = 2e-3  # of a window: it is cut to whole samples, so it may be a little shorter than requested
_WINDOW, _PRE_TRIGGER, _INTERVAL, _HOLD = 2.0, 0.3, 60.0, 0.85  # s on the paper's servo
_ABSENT = "; where absent {:g} s on the paper's servo, scaled to the time of another"
_SILENT = (GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND)
_ALLOWANCE = 4.0  # a teaching move tells the ratio so many times better than needed: rounding repeats, and 2 did not do
_LESSONS = 3  # moves of different lengths that were made in vain, after which an engineer is told
_RAREST = 20  # times that the pause between these doubles


@settings("excitation")
@dataclass(frozen=True)
class ExcitationSettings:
    """Settings of the requests that the twin may send to the edge when windows are uninformative.

    Raises
    ------
    InvalidInput
        A value is out of its range.
    """

    after: Annotated[
        int,
        key(minimum=1, help="Number of consecutive uninformative windows after which the twin sends a request."),
    ] = 2
    window: Annotated[
        float | None,
        key("window_s", above=0.0, help=f"Length of the requested windows{_ABSENT.format(_WINDOW)}."),
    ] = None
    pre_trigger: Annotated[
        float | None,
        key(
            "pre_trigger_s",
            minimum=0.0,
            help=f"Part of them before the change of the reference, below window_s{_ABSENT.format(_PRE_TRIGGER)}.",
        ),
    ] = None
    probe: Annotated[
        float, key("probe_mm", "probe_deg", minimum=0.0, help="Largest probing move; 0: none is requested.")
    ] = 0.0
    interval: Annotated[
        float | None,
        key("interval_s", above=0.0, help=f"Time from one probing move to the next{_ABSENT.format(_INTERVAL)}."),
    ] = None
    hold: Annotated[
        float | None,
        key(
            "hold_s",
            above=0.0,
            help=f"Time at each place of a probing move, and of the window after its return{_ABSENT.format(_HOLD)}.",
        ),
    ] = None
    strokes: Annotated[int, key(minimum=1, help="Number of moves there and back.")] = 1
    margin: Annotated[
        float,
        key(
            "margin_deg",
            above=0.0,
            help="Angle by which it turns the screw beyond the gap. The estimator needs 0.5 deg in each direction; the "
            "rest is for the time that the loop takes to cross the gap.",
        ),
    ] = math.radians(5.0)

    def __post_init__(self) -> None:
        check(self)
        if self.times.pre_trigger < self.times.window:
            return
        if self.pre_trigger is None:
            rule = f"{{0}}: must be above {_PRE_TRIGGER!r} s, the pre-trigger of the paper's servo"
            raise contradiction(self, rule, "window")
        if self.window is None:
            raise contradiction(self, f"{{0}}: must be below {_WINDOW!r} s, the paper's servo's window", "pre_trigger")
        raise contradiction(self, "{0}: must be below {1}", "pre_trigger", "window")

    @property
    def times(self) -> ExcitationTimes:
        """Times that are stated, and the paper's servo's for those that are not."""
        defaults = (_WINDOW, _PRE_TRIGGER, _INTERVAL, _HOLD)
        stated = (self.window, self.pre_trigger, self.interval, self.hold)
        return ExcitationTimes(*(d if s is None else s for s, d in zip(stated, defaults, strict=True)))

    def on(self, second: float) -> ExcitationSettings:
        """The settings for a servo whose own second (`plant.scales`) is so many seconds.

        A pre-trigger that is absent is never longer than its part of a stated window.
        """
        window = _WINDOW * second if self.window is None else self.window
        before = min(_PRE_TRIGGER * second, 0.5 * window) if self.pre_trigger is None else self.pre_trigger
        interval = _INTERVAL * second if self.interval is None else self.interval
        return replace(
            self,
            window=window,
            pre_trigger=before,
            interval=interval,
            hold=_HOLD * second if self.hold is None else self.hold,
        )


class ExcitationTimes(NamedTuple):
    """Window, pre-trigger, time between probing moves, and duration of one, s."""

    window: float
    pre_trigger: float
    interval: float
    hold: float


class Stage(StrEnum):
    """Stage of a request."""

    # The values are part of the twin's stored state.
    OPEN = "not asked for"
    REQUESTED = "asked for"
    ACCEPTED = "taken"
    REFUSED = "refused"


@dataclass(frozen=True)
class WindowSummary:
    """Information in one window, and the bounds after it.

    Attributes
    ----------
    time : float
        Time on any steady clock, s.
    status : GapStatus
    long : bool
        True for a window of the length and pre-trigger that would be requested, or cut for a probing move.
    upper : float
        rad, upper bound of the gap.
    slack : float
        m, motion of the reference to which the loop does not react: both thresholds of the dead zone together; NaN: not
        known.
    ratio : UnknownRatio, optional
        The transmission's ratio, where the window does not tell the gap from it.
    noise : float
        m, root mean square of what the estimate leaves unexplained; NaN: not known.
    taught : bool
        True where it told the ratio.
    unconfirmed : bool
        True where its contact and that of the window before show a gap for the first time.
    """

    time: float
    status: GapStatus
    long: bool
    upper: float
    slack: float = 0.0
    ratio: UnknownRatio | None = None
    noise: float = math.nan
    taught: bool = False
    unconfirmed: bool = False


@dataclass(frozen=True)
class ExcitationState:
    """State of the policy within one boot of the edge.

    Attributes
    ----------
    misses : int
        Consecutive uninformative windows, since the last informative one or the last request.
    window, probing, teaching : Stage
        Of requests for longer windows, for moves there and back, and for moves of different lengths.
    probed : float
        s, time of the last request for a probing move.
    lessons : int
        Moves of different lengths that the edge has accepted, since a window that told the ratio.
    """

    misses: int = 0
    window: Stage = Stage.OPEN
    probing: Stage = Stage.OPEN
    probed: float = -math.inf
    teaching: Stage = Stage.OPEN
    lessons: int = 0

    def rebooted(self) -> ExcitationState:
        """State after a boot of the edge, which cuts windows as configured again."""
        return ExcitationState(probed=self.probed)

    def answered(self, ask: Ask, outcome: RequestOutcome | None) -> ExcitationState:
        """State after the edge's last answer to a request; None: it never answered.

        A request that the edge does not allow is not repeated.
        """
        refused = outcome in (RequestOutcome.NOT_ALLOWED, RequestOutcome.TOO_LARGE)
        stage = Stage.REFUSED if refused else Stage.ACCEPTED if outcome is RequestOutcome.ACCEPTED else Stage.OPEN
        if isinstance(ask, LongerWindow):
            return replace(self, window=stage)
        if ask.teaches:
            return replace(self, teaching=stage, lessons=self.lessons + (stage is Stage.ACCEPTED))
        return replace(self, probing=stage)


@dataclass(frozen=True)
class Decision:
    """Decision on a request (None: no request), with its reason.

    `prevented`: why moves of different lengths, which are needed, will not be requested; empty otherwise.
    """

    state: ExcitationState
    ask: Ask | None
    reason: str
    prevented: str = ""


@dataclass(frozen=True)
class ExcitationPolicy:
    """Policy for requests that would make the gap known.

    Parameters
    ----------
    pitch : float
        m/rad, travel per angle of the screw.
    settings : ExcitationSettings
    unit : DisplayUnit
        Unit of the moves in the reasons.
    """

    pitch: float
    settings: ExcitationSettings
    unit: DisplayUnit = MILLIMETRES

    def decide(self, state: ExcitationState, window: WindowSummary) -> Decision:
        """Decide after one more window."""
        if window.status not in _SILENT:
            known = window.status is GapStatus.OK
            why = "the window shows the gap" if known else "the window is at odds with the model, which no motion cures"
            return Decision(replace(state, misses=0, lessons=0 if window.taught else state.lessons), None, why)
        state = replace(state, misses=state.misses + 1)
        if window.ratio is not None:
            return self._teach(state, window, window.ratio)
        if not window.long and state.window is not Stage.REFUSED:
            return self._window(state)
        if state.misses < self.settings.after:
            return Decision(state, None, self._missed(state))
        if window.unconfirmed:
            return Decision(
                state, None, f"{self._missed(state)}, but two contacts show it: the next one may confirm it"
            )
        return self._probe(state, window)

    def needed(self, window: WindowSummary) -> float:
        """Size of a probing move, m: across the widest gap that is possible, and the margin beyond it.

        In the steady state the screw follows the reference but for the dead zone, whatever the gap; crossing the gap
        within the hold time takes an error of the gap's size.
        """
        return window.slack + self.pitch * (window.upper + self.settings.margin)

    def lengths(self, window: WindowSummary, ratio: UnknownRatio) -> tuple[float, float]:
        """Lengths of moves that tell the ratio from the gap, m: each crosses the gap, and the second is the size.

        On each flank the motor rests at places as far apart as the two differ: errors of position over this difference
        make the error of the ratio.
        """
        shortest = window.slack + self.pitch * (min(window.upper, ratio.widest) + self.settings.margin)
        apart = _ALLOWANCE * window.noise / min(ratio.needed, ratio.known)
        return shortest, shortest + (max(shortest, apart) if math.isfinite(apart) else math.inf)

    def _shown(self, move: float) -> str:
        return f"{self.unit.factor * move:.3g} {self.unit.name}"

    def _missed(self, state: ExcitationState) -> str:
        several = f"{state.misses} windows in a row tell" if state.misses > 1 else "1 window tells"
        enough = "" if state.misses >= self.settings.after else f", a request follows after {self.settings.after}"
        refused = ", longer ones are refused" if state.window is Stage.REFUSED else ""
        return f"{several} too little of the gap{enough}{refused}"

    def _window(self, state: ExcitationState) -> Decision:
        """Request longer windows; misses of shorter ones do not count against the longer ones."""
        s = self.settings.times
        if state.window is not Stage.OPEN:
            return Decision(replace(state, misses=0), None, f"a longer window is {state.window.value} already")
        if state.misses < self.settings.after:
            return Decision(state, None, self._missed(state))
        longer = f"one of {s.window:g} s, with {s.pre_trigger:g} s before the move, is more informative"
        why = f"{self._missed(state)}: {longer}"
        after = replace(state, misses=0, window=Stage.REQUESTED)
        return Decision(after, LongerWindow(s.window, s.pre_trigger), why)

    def _teach(self, state: ExcitationState, window: WindowSummary, ratio: UnknownRatio) -> Decision:
        """Request moves of different lengths; a longer window of the same moves would tell no more.

        After each that was in vain the pause is twice as long: a gap may be too small for now.
        """
        if state.misses < self.settings.after:
            return Decision(state, None, self._missed(state))
        shortest, size = self.lengths(window, ratio)
        missed = f"{self._missed(state)}, because the ratio is known to {100.0 * ratio.known:.2g} %"
        missed += f" and {100.0 * ratio.needed:.2g} % are needed"
        prevented = self._prevented(state.teaching, size)
        wait = self._wait(state, window, 2.0 ** min(state.lessons, _RAREST))
        if wait and not prevented and state.lessons >= _LESSONS:
            prevented = f"{state.lessons} probing moves of different lengths did not tell it, or were cut short"
        if why_not := prevented or wait:
            return Decision(state, None, f"{missed}, and {why_not}", prevented)
        share, s = shortest / size, self.settings
        ask = Probe(size, s.times.hold, s.strokes, (share, 0.0, 1.0, 1.0 - share, 1.0, 0.0))
        after = replace(state, misses=0, teaching=Stage.REQUESTED, probed=window.time)
        return Decision(after, ask, f"{missed}: moves of {self._shown(shortest)} and {self._shown(size)} tell it")

    def _probe(self, state: ExcitationState, window: WindowSummary) -> Decision:
        s, needed = self.settings, self.needed(window)
        why_not = self._prevented(state.probing, needed) or self._wait(state, window)
        if why_not:
            return Decision(state, None, f"{self._missed(state)}, and {why_not}")
        after = replace(state, misses=0, probing=Stage.REQUESTED, probed=window.time)
        why = f"{self._missed(state)}: a move of {self._shown(needed)} crosses "
        why += f"a gap of {math.degrees(window.upper):.3g} deg"
        return Decision(after, Probe(needed, s.times.hold, s.strokes), why)

    def _prevented(self, stage: Stage, needed: float) -> str:
        """Reason for which a move of a size (m) is never requested; empty where there is none."""
        most = self.settings.probe
        if most == 0.0:
            return "a probing move is not allowed"
        if stage is Stage.REFUSED:
            return "this edge refuses probing moves"
        if not math.isfinite(needed):
            return "gap and dead zone are not bounded well enough to size a probing move"
        if needed > most:
            return f"a probing move must be {self._shown(needed)}, and at most {self._shown(most)} are allowed"
        return ""

    def _wait(self, state: ExcitationState, window: WindowSummary, longer: float = 1.0) -> str:
        """Reason for which a probing move has to wait, for a pause so many times `longer`; empty: none."""
        pause, since = longer * self.settings.times.interval, window.time - state.probed
        if since < pause:
            return f"the last probing move was requested {since:.3g} s ago, and {pause:g} s must lie between two"
        return ""


def long_enough(length: float, pre_trigger: float, settings: ExcitationSettings) -> bool:
    """True where a window (s) is as long as would be requested."""
    times = settings.times
    rounding = _ROUNDING * times.window
    return length >= times.window - rounding and pre_trigger >= times.pre_trigger - rounding
