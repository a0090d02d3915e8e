"""Excitation: requests for longer windows where windows are uninformative, and only then for a probing move.

The calmer a loop, the less informative its windows (dual control). A longer window costs only bytes; a move of the
reference disturbs the machine, so the policy requests it only where the configuration allows it, no larger than needed,
and rarely. The policy is a pure function of its state and one window; every decision carries its reason.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapStatus
from servotwin.messages import Ask, LongerWindow, Probe, RequestOutcome

_ROUNDING = 1e-6  # s: a window is cut to whole samples, so it may be a little shorter than requested
_SILENT = (GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND)


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
    window: Annotated[float, key("window_s", above=0.0, help="Length of the requested windows.")] = 2.0
    pre_trigger: Annotated[
        float,
        key("pre_trigger_s", minimum=0.0, help="Part of them before the change of the reference, below window_s."),
    ] = 0.3
    probe: Annotated[float, key("probe_mm", minimum=0.0, help="Largest probing move; 0: none is requested.")] = 0.0
    interval: Annotated[float, key("interval_s", above=0.0, help="Time from one probing move to the next.")] = 60.0
    hold: Annotated[
        float,
        key(
            "hold_s",
            above=0.0,
            help="Duration of a probing move, and of the window after its return.",
        ),
    ] = 0.85
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
        if not self.pre_trigger < self.window:
            allowed = f"must be below window = {self.window!r} s"
            raise InvalidInput(f"excitation pre_trigger = {self.pre_trigger!r} s: {allowed}")


class Stage(StrEnum):
    """Stage of a request."""

    # The values are part of the twin's stored state.
    OPEN = "not asked for"
    REQUESTED = "asked for"
    TAKEN = "taken"
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
    """

    time: float
    status: GapStatus
    long: bool
    upper: float
    slack: float = 0.0


@dataclass(frozen=True)
class ExcitationState:
    """State of the policy within one boot of the edge.

    Attributes
    ----------
    misses : int
        Consecutive uninformative windows, since the last informative one or the last request.
    window, probing : Stage
    probed : float
        s, time of the last request for a probing move.
    """

    misses: int = 0
    window: Stage = Stage.OPEN
    probing: Stage = Stage.OPEN
    probed: float = -math.inf

    def rebooted(self) -> ExcitationState:
        """State after a boot of the edge, which cuts windows as configured again."""
        return ExcitationState(probed=self.probed)

    def answered(self, ask: Ask, outcome: RequestOutcome | None) -> ExcitationState:
        """State after the edge's last answer to a request; None: it never answered.

        A request that the edge does not allow is not repeated.
        """
        refused = outcome in (RequestOutcome.NOT_ALLOWED, RequestOutcome.TOO_LARGE)
        stage = Stage.REFUSED if refused else Stage.TAKEN if outcome is RequestOutcome.TAKEN else Stage.OPEN
        return replace(self, window=stage) if isinstance(ask, LongerWindow) else replace(self, probing=stage)


@dataclass(frozen=True)
class Decision:
    """Decision on a request (None: no request), with its reason."""

    state: ExcitationState
    ask: Ask | None
    reason: str


@dataclass(frozen=True)
class ExcitationPolicy:
    """Policy for requests that would make the gap known.

    Parameters
    ----------
    pitch : float
        m/rad, travel per angle of the screw.
    settings : ExcitationSettings
    """

    pitch: float
    settings: ExcitationSettings

    def decide(self, state: ExcitationState, window: WindowSummary) -> Decision:
        """Decide after one more window."""
        if window.status not in _SILENT:
            known = window.status is GapStatus.OK
            why = "the window shows the gap" if known else "the window is at odds with the model, which no motion cures"
            return Decision(replace(state, misses=0), None, why)
        state = replace(state, misses=state.misses + 1)
        if not window.long and state.window is not Stage.REFUSED:
            return self._window(state)
        if state.misses < self.settings.after:
            return Decision(state, None, self._missed(state))
        return self._probe(state, window)

    def needed(self, window: WindowSummary) -> float:
        """Size of a probing move, m: across the widest gap that is possible, and the margin beyond it.

        In the steady state the screw follows the reference but for the dead zone, whatever the gap; crossing the gap
        within the hold time takes an error of the gap's size.
        """
        return window.slack + self.pitch * (window.upper + self.settings.margin)

    def _missed(self, state: ExcitationState) -> str:
        several = f"{state.misses} windows in a row tell" if state.misses > 1 else "1 window tells"
        enough = "" if state.misses >= self.settings.after else f", a request follows after {self.settings.after}"
        refused = ", longer ones are refused" if state.window is Stage.REFUSED else ""
        return f"{several} too little of the gap{enough}{refused}"

    def _window(self, state: ExcitationState) -> Decision:
        """Request longer windows; misses of shorter ones do not count against the longer ones."""
        s = self.settings
        if state.window is not Stage.OPEN:
            return Decision(replace(state, misses=0), None, f"a longer window is {state.window.value} already")
        if state.misses < s.after:
            return Decision(state, None, self._missed(state))
        why = f"{self._missed(state)}: one of {s.window:g} s, {s.pre_trigger:g} s of it before the move, tells more"
        after = replace(state, misses=0, window=Stage.REQUESTED)
        return Decision(after, LongerWindow(s.window, s.pre_trigger), why)

    def _probe(self, state: ExcitationState, window: WindowSummary) -> Decision:
        s, needed = self.settings, self.needed(window)
        why_not = self._why_not(state, window, needed)
        if why_not:
            return Decision(state, None, f"{self._missed(state)}, and {why_not}")
        after = replace(state, misses=0, probing=Stage.REQUESTED, probed=window.time)
        why = f"{self._missed(state)}: a move of {_mm(needed)} crosses a gap of {math.degrees(window.upper):.3g} deg"
        return Decision(after, Probe(needed, s.hold, s.strokes), why)

    def _why_not(self, state: ExcitationState, window: WindowSummary, needed: float) -> str:
        """Reason against a probing move; empty where there is none."""
        s, since = self.settings, window.time - state.probed
        if s.probe == 0.0:
            return "a probing move is not allowed"
        if state.probing is Stage.REFUSED:
            return "this edge refuses probing moves"
        if since < s.interval:
            return f"the last probing move was requested {since:.3g} s ago, and {s.interval:g} s must lie between two"
        if not math.isfinite(needed):
            return "gap and dead zone are not bounded well enough to size a probing move"
        if needed > s.probe:
            return f"a probing move must be {_mm(needed)}, and at most {_mm(s.probe)} are allowed"
        return ""


def long_enough(length: float, pre_trigger: float, settings: ExcitationSettings) -> bool:
    """True where a window (s) is as long as would be requested."""
    return length >= settings.window - _ROUNDING and pre_trigger >= settings.pre_trigger - _ROUNDING


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"
