"""Knowledge of a servo from its windows, from one to the next: gap and wear, the machine's and the motor's numbers.

`Wear.update` takes one window's estimate, and `Wear.expect` says what is known before the next one. The parts are in
this package: the trend of the gap (`trend`), falls that no wear explains (`falls`), the machine's stiffness, damping,
pitch and mass ratio (`machine`), and the motor's back EMF, lag, friction and input bias (`motor`). Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace

from servotwin.estimation.estimate import NORMAL_95, CarriedOffset, GapEstimate, GapStatus, LastContact
from servotwin.estimation.learning.falls import Falls
from servotwin.estimation.learning.machine import LearningSettings, LearntMachine, updated
from servotwin.estimation.learning.motor import LearntMotor, MotorLearning
from servotwin.estimation.learning.trend import Trend, TrendSettings
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window

_JUMPS = 2  # contacts that are not where they were: once an encoder may have slipped, or have been homed anew
_WHY_FALLEN = "after a repair or a new screw it may; else an encoder has slipped, or two machines have this name"
NOT_LEARNING = LearningSettings(learn=False)


@dataclass(frozen=True)
class Expectation:
    """Knowledge about the gap before a window is estimated.

    Attributes
    ----------
    previous : float
        rad: the last accepted gap, or the initial gap.
    trend : Trend or None
        The wear as predicted for the middle of the window; None before the first accepted estimate.
    machine : FactorPrior or None
        What earlier windows told of the machine's numbers; None: nothing.
    contact : LastContact or None
        Last contact of the last window of this boot that showed one only; None: there was none.
    """

    previous: float
    trend: Trend | None = None
    machine: FactorPrior | None = None
    contact: LastContact | None = None

    @property
    def prior(self) -> float | GapEstimate:
        """Starting point of an estimator: the predicted gap, or the previous one while there is no prediction."""
        return self.previous if self.trend is None else self.trend.as_estimate()

    @property
    def offset(self) -> tuple[float, float] | None:
        """Mean and standard deviation (rad) of the encoder's offset; None while no window of this boot showed it.

        The offset is the middle between two contacts, and the gap their distance. So half of the error that all windows
        share applies to the offset.
        """
        if self.trend is None or self.trend.prior.offset_std >= self.trend.settings.offset_std_rad:
            return None
        known, shared = self.trend.prior, self.trend.settings.shared_error(self.trend.gap)
        return known.offset, math.hypot(known.offset_std, 0.5 * shared)

    @property
    def widest(self) -> float:
        """Upper bound of the gap, rad; inf where nothing is known."""
        return math.inf if self.trend is None else self.trend.gap_interval[1]

    def gap_rate(self, settings: TrendSettings) -> float:
        """Expected growth of the gap within the window, root mean square, rad/s.

        Without it a growing gap is taken for a wrong model, and its value is that of whenever the screw crossed it: of
        Fig 16's windows one in three was refused, and in the calm loop estimates were off by up to 0.04 deg.
        """
        rate, std = (0.0, settings.rate_std_rad_per_s) if self.trend is None else (self.trend.rate, self.trend.rate_std)
        return math.hypot(rate, std)


class TrendState(Struct, frozen=True):
    """A `Trend` as plain numbers, without its settings; `covariance` row by row."""

    time: float
    mean: Annotated[tuple[float, ...], Meta(min_length=3, max_length=3)]
    covariance: Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)]
    updates: int
    refused: int
    reasons: tuple[str, ...]
    rival: TrendState | None

    @classmethod
    def of(cls, trend: Trend) -> TrendState:
        """Make the plain numbers of a trend."""
        return cls(
            time=float(trend.time),
            mean=tuple(trend.mean.tolist()),
            covariance=tuple(trend.covariance.ravel().tolist()),
            updates=trend.updates,
            refused=trend.refused,
            reasons=trend.reasons,
            rival=None if trend.rival is None else cls.of(trend.rival),
        )

    def trend(self, settings: TrendSettings) -> Trend:
        """Make the trend again, bit for bit."""
        return Trend(
            time=self.time,
            mean=np.array(self.mean),
            covariance=np.array(self.covariance).reshape(3, 3),
            settings=settings,
            updates=self.updates,
            refused=self.refused,
            reasons=self.reasons,
            rival=None if self.rival is None else self.rival.trend(settings),
        )


class Wear(Struct, frozen=True):
    """The trend of one servo, moved by accepted estimates in the order of their windows.

    Sample time begins anew with each boot of the edge. The time between two boots is taken from the twin's own clock.
    The encoder's offset is forgotten then, as the encoder may be homed elsewhere.

    Attributes
    ----------
    previous : float
        rad, gap of the last accepted estimate; before the first one, the initial gap.
    boot, arrived : str, float
        Boot and arrival (s, on the twin's clock) of the last window that changed the trend.
    state : TrendState or None
        None before the first estimate.
    machine : LearntMachine or None
        None before a window told of the machine's numbers.
    motor : LearntMotor or None
        None before a window told of the motor's numbers.
    mismatches : int
        Windows in a row that no model within what is known explains; windows that show too little do not count.
    lapses, fitting : int
        Such rows that windows that fit have ended, and how many of these came since, up to `restart_after` in a row,
        which ends the count.
    at_limit, limited : int, float
        Windows in a row that tell nothing of the motor because its commands were at the drive's limit, and the share of
        the last one's commands that were.
    contact, contact_boot : LastContact or None, str
        Last contact of the last window that showed one only, and its boot.
    falls : Falls or None
        None before the first accepted estimate.
    """

    previous: float
    boot: str = ""
    arrived: float = 0.0
    state: TrendState | None = None
    machine: LearntMachine | None = None
    motor: LearntMotor | None = None
    mismatches: int = 0
    lapses: int = 0
    fitting: int = 0
    at_limit: int = 0
    limited: float = 0.0
    contact: LastContact | None = None
    contact_boot: str = ""
    falls: Falls | None = None

    @property
    def by_turns(self) -> bool:
        """True while the gap falls and rises by turns: no setting may rest on it."""
        return self.falls is not None and self.falls.by_turns

    @property
    def jumps(self) -> int:
        """Contacts that were not where the one before on the same side was, since two last confirmed each other."""
        return 0 if self.contact is None else self.contact.jumps

    def trend(self, settings: TrendSettings) -> Trend | None:
        """The trend as the last estimate left it."""
        return None if self.state is None else self.state.trend(settings)

    def expect(
        self, settings: TrendSettings, boot: str, time: float, now: float, learning: LearningSettings = NOT_LEARNING
    ) -> Expectation:
        """Expectation of a window of `boot` with its middle at `time` (s) that arrived at `now`.

        For a window older than the trend it is the present trend, not predicted.
        """
        trend = self._on_clock(settings, boot, time, now)
        known = self.known_machine(learning, now)
        contact = self.contact if boot == self.contact_boot else None
        return Expectation(self.previous, trend and trend.predict(max(time, trend.time)), known, contact)

    def known_machine(self, learning: LearningSettings, now: float) -> FactorPrior | None:
        """The machine's numbers as learnt, at a time (s, on the twin's clock); None: nothing, or learning is off."""
        return self.machine.prior(learning, now) if learning.learn and self.machine is not None else None

    def update(
        self,
        settings: TrendSettings,
        boot: str,
        estimate: GapEstimate,
        now: float,
        learning: LearningSettings = NOT_LEARNING,
        stated: FactorPrior | None = None,
        window: Window | None = None,
        motor: MotorLearning | None = None,
    ) -> tuple[Wear, str]:
        """Learn from a window: the trend and the machine from its estimate, the motor from the window itself.

        Parameters
        ----------
        settings : TrendSettings
        boot : str
            Boot of the window.
        estimate : GapEstimate
        now : float
            s, on the twin's clock: arrival of the window.
        learning : LearningSettings, optional
        stated : FactorPrior, optional
            Numbers of the machine as the nameplate states them.
        window : Window, optional
            None: its numbers are unusable.
        motor : MotorLearning, optional
            None: the motor's numbers are not learnt.

        Returns
        -------
        (Wear, str)
            Knowledge after the window, and the reason for which no update may follow from it; empty: it may.
        """
        wear, rejection = self._update_trend(settings, boot, estimate, now)
        if not rejection:
            seen = Falls(estimate.gap, estimate.std_total)
            if self.falls is not None:
                shared, sure = settings.shared_error(seen.gap), settings.outlier_std
                seen = self.falls.after(estimate, shared, sure, learning.restart_after)
            wear = replace(wear, falls=seen)
        wear = self._with_mismatches(wear, estimate, learning.restart_after)
        if (contact := estimate.contact) is not None and self._is_newer(contact, boot):
            wear = replace(wear, contact=contact, contact_boot=boot)
        elif contact is None and estimate.ok and self.jumps > 0:
            wear = replace(wear, contact=None)  # the window shows both sides: the encoder's offset is known again
        if motor is not None and window is not None:
            wear = self._with_motor(wear, motor, window, now)
        if not learning.learn:
            return wear, rejection
        machine = updated(self.machine, learning, estimate, counts=not rejection, now=now, stated=stated)
        return replace(wear, machine=machine), rejection

    def _is_newer(self, contact: LastContact, boot: str) -> bool:
        """True for a contact later than the last one, or of another boot."""
        return self.contact is None or boot != self.contact_boot or contact.time > self.contact.time

    def _with_motor(self, wear: Wear, motor: MotorLearning, window: Window, now: float) -> Wear:
        """`wear` with what the window tells of the motor, or that it was at its drive's limit."""
        learnt, share = motor.updated(self.motor, window, now), motor.lost_at_limit(window)
        count = self.at_limit + 1 if share else self.at_limit if learnt == self.motor else 0
        return replace(wear, motor=learnt, at_limit=count, limited=share)

    def alarms(
        self,
        before: Wear,
        estimate: GapEstimate,
        settings: TrendSettings,
        learning: LearningSettings,
        motor: MotorLearning | None = None,
    ) -> list[str]:
        """List what an operator should know of the machine after a window, besides what was learnt.

        `before` is the knowledge before the window, and `estimate` its estimate.
        """
        sentences, count = list[str](), learning.restart_after
        because, unknown = "; ".join(estimate.reasons), self.machine == before.machine
        if self.mismatches == count > before.mismatches and unknown:
            sentences.append(
                f"{count} windows in a row fit no machine within what is known of this one ({because}): check the "
                "nameplate (stiffness, damping, pitch, masses), the channels' units, and what may be loose"
            )
        elif self.mismatches == 1 > before.mismatches and self.lapses == count - 1 and unknown:
            sentences.append(
                f"windows that fit no machine within what is known of this one come by turns with others ({because}): "
                "two machines may have its name, or it is one with two loads"
            )
        if motor is not None and self.at_limit == count > before.at_limit:
            sentences.append(
                f"{count} windows in a row tell nothing of the motor (back EMF, lag, friction, input bias): the "
                f"command is at the drive's limit of {motor.limit:g} V in {100.0 * self.limited:.3g} % of the samples; "
                "check the limit, the load and the steps of the reference"
            )
        if self.jumps == _JUMPS > before.jumps:
            sentences.append(
                f"{_JUMPS} times the motor met the screw elsewhere than before on the same side, by more than wear "
                "moves it: an encoder slips, or the windows are of two machines; no gap is read from such windows "
                "together"
            )
        trend, earlier = self.trend(settings), before.trend(settings)
        afresh = trend if trend is not None and trend.afresh else None
        sentences += self._fallen(before, jumped=afresh is not None)
        if afresh is not None and earlier is not None and not earlier.afresh:
            sentences.append(
                f"the gap has jumped from {math.degrees(earlier.gap):.3g} to {math.degrees(afresh.gap):.3g} deg, as "
                "after a crash, a repair or a new screw: it is followed from there"
            )
        return sentences + _moved(trend, earlier)

    def remarks(
        self, before: Wear, estimate: GapEstimate, settings: TrendSettings, learning: LearningSettings
    ) -> list[str]:
        """List what a reader of a log should know after a window: as `alarms`, with those of the machine's numbers.

        Parameters and result are those of `alarms`.
        """
        sentences = self.alarms(before, estimate, settings, learning)
        if self.machine is not None and self.machine != before.machine and self.machine.alarm:
            sentences.append(self.machine.alarm)
        return sentences

    def _fallen(self, before: Wear, jumped: bool) -> list[str]:
        """Sentence on a gap that has fallen with this window, or once more; empty without one, or if a jump is said."""
        now, then = self.falls, before.falls
        if now is None or then is None:
            return []
        ways = f"from {math.degrees(then.gap):.3g} to {math.degrees(now.gap):.3g} deg"
        if now.by_turns and not then.by_turns:
            return [
                f"the gap falls and rises by turns, now {ways}, which no wear does: two machines may have this name, "
                "or it is another gap in other places; none is relied on until it has been one for some windows"
            ]
        if now.fallen > 0.0 == then.fallen and not jumped:
            return [f"the gap has fallen {ways}, which no wear does: {_WHY_FALLEN}"]
        return []

    def _with_mismatches(self, wear: Wear, estimate: GapEstimate, enough: int) -> Wear:
        """`wear` with the count of windows that fit no machine; `enough` that fit in a row end that of lapses."""
        if estimate.status is GapStatus.MODEL_MISMATCH:
            return replace(wear, mismatches=self.mismatches + 1)
        if not estimate.ok or self.mismatches == self.lapses == 0:
            return wear
        ended = self.mismatches > 0
        fitting = 1 if ended else self.fitting + 1
        if fitting >= enough:
            return replace(wear, mismatches=0, lapses=0, fitting=0)
        return replace(wear, mismatches=0, lapses=self.lapses + ended, fitting=fitting)

    def _update_trend(self, settings: TrendSettings, boot: str, estimate: GapEstimate, now: float) -> tuple[Wear, str]:
        """Return the wear after an estimate, and the reason for which no update may follow from it; empty: it may.

        An estimate that is not OK, or older than the trend, moves nothing; one that does not fit the carried offset
        ends its use. An outlier leaves the prediction, with the reason in the trend's `reasons`, until others agree
        with it.
        """
        if not estimate.ok:
            wear = self._without_offset(settings, boot) if isinstance(estimate.offset, CarriedOffset) else self
            return wear, f"the estimate is {estimate.status.value}: {'; '.join(estimate.reasons) or 'no reason given'}"
        trend = self._on_clock(settings, boot, estimate.time, now)
        if self.state is not None and trend is not None and estimate.time <= trend.time:
            return self, "; ".join(self.state.reasons) or "the window is older than the trend"
        after = (trend or Trend.start(estimate.time, settings)).update(estimate)
        counts = after.refused == 0
        previous = float(estimate.gap) if counts else self.previous
        rejection = "" if counts else "; ".join(after.reasons) or "the window is older than the trend"
        after_state = TrendState.of(after)
        return replace(self, previous=previous, boot=boot, arrived=now, state=after_state), rejection

    def _without_offset(self, settings: TrendSettings, boot: str) -> Wear:
        """The wear without the encoder's offset of a boot."""
        trend = self.trend(settings)
        if trend is None or boot != self.boot:
            return self
        return replace(self, state=TrendState.of(trend.without_offset()))

    def _on_clock(self, settings: TrendSettings, boot: str, time: float, now: float) -> Trend | None:
        """The trend on the clock of `boot`."""
        trend = self.trend(settings)
        if trend is None or boot == self.boot:
            return trend
        return trend.without_offset().on_clock(time - max(0.0, now - self.arrived))


def _moved(trend: Trend | None, before: Trend | None) -> list[str]:
    """Say by how much the encoders have moved against each other, where a window has just shown that."""
    if trend is None or before is None or not trend.moved or before.moved:
        return []
    by = math.degrees(trend.prior.offset - before.prior.offset)
    known = math.degrees(NORMAL_95 * math.hypot(trend.prior.offset_std, before.prior.offset_std))
    return [
        f"the encoders have moved against each other by {by:.3g} ± {known:.2g} deg of the motor: one has "
        "lost counts, slips or was homed anew, or the gap wears on one side only"
    ]
