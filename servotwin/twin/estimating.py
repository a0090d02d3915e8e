"""Estimation in the twin: decoding of a window, choice of the estimator, and wear between windows. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import msgspec.structs
import numpy as np
from msgspec import Meta, Struct

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.estimation import whitened
from servotwin.estimation.disturbance import Disturbance, nothing_known
from servotwin.estimation.estimate import GapEstimate, GapStatus, no_estimate
from servotwin.estimation.gap import estimate_gap, settings_of
from servotwin.estimation.machine import LearningSettings, LearntMachine, nameplate, updated
from servotwin.estimation.motor import LearntMotor, MotorLearning
from servotwin.estimation.offset import estimate_carrying
from servotwin.estimation.trend import Trend, TrendSettings
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import CHANNELS, Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array, SignalLike, as_nonnegative
from servotwin.redesign.policy import NOT_OBSERVED
from servotwin.twin.settings import TwinSettings

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
    """

    previous: float
    trend: Trend | None = None
    machine: FactorPrior | None = None

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
        known, shared = self.trend.prior, self.trend.settings.shared_error_rad
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
    """

    previous: float
    boot: str = ""
    arrived: float = 0.0
    state: TrendState | None = None
    machine: LearntMachine | None = None
    motor: LearntMotor | None = None
    mismatches: int = 0

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
        return Expectation(self.previous, trend and trend.predict(max(time, trend.time)), known)

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
    ) -> tuple[Wear, str]:
        """Return trend and machine after an estimate, and the reason for which no update may follow; empty: it may.

        `stated`: what the nameplate states of the machine.
        """
        wear, rejection = self._update_trend(settings, boot, estimate, now)
        if wear.mismatches != (mismatches := self._mismatches(estimate)):
            wear = msgspec.structs.replace(wear, mismatches=mismatches)
        if not learning.learn:
            return wear, rejection
        machine = updated(self.machine, learning, estimate, counts=not rejection, now=now, stated=stated)
        return msgspec.structs.replace(wear, machine=machine), rejection

    def _mismatches(self, estimate: GapEstimate) -> int:
        """`mismatches` after an estimate."""
        if estimate.status is GapStatus.MODEL_MISMATCH:
            return self.mismatches + 1
        return 0 if estimate.ok else self.mismatches

    def _update_trend(self, settings: TrendSettings, boot: str, estimate: GapEstimate, now: float) -> tuple[Wear, str]:
        """Return the wear after an estimate, and the reason for which no update may follow from it; empty: it may.

        An estimate that is not OK, or older than the trend, changes nothing. An outlier leaves the prediction, with the
        reason in the trend's `reasons`, until others agree with it.
        """
        if not estimate.ok:
            return self, f"the estimate is {estimate.status.value}: {'; '.join(estimate.reasons) or 'no reason given'}"
        trend = self._on_clock(settings, boot, estimate.time, now)
        if self.state is not None and trend is not None and estimate.time <= trend.time:
            return self, "; ".join(self.state.reasons) or "the window is older than the trend"
        after = (trend or Trend.start(estimate.time, settings)).update(estimate)
        counts = after.refused == 0
        previous = float(estimate.gap) if counts else self.previous
        rejection = "" if counts else "; ".join(after.reasons) or "the window is older than the trend"
        return Wear(previous, boot, now, TrendState.of(after), self.machine, self.motor), rejection

    def _on_clock(self, settings: TrendSettings, boot: str, time: float, now: float) -> Trend | None:
        """The trend on the clock of `boot`."""
        trend = self.trend(settings)
        if trend is None or boot == self.boot:
            return trend
        return trend.without_offset().on_clock(time - max(0.0, now - self.arrived))


Estimator = Callable[[Window, Expectation], GapEstimate]
"""(window, expectation) -> estimate."""

Observer = Callable[[Window], Disturbance]
"""window -> input bias and noise."""

UNUSABLE = "none"
"""Method of the estimate of an unusable window; a probing move would not improve it."""

_TAIL = 10  # the last one of so many parts of a window


def stated_machine(settings: TwinSettings) -> FactorPrior:
    """Make the prior that the nameplate states of the machine."""
    known = settings.uncertainty
    return nameplate(settings.learning, known.k, known.c, known.m)


def estimator_of(servo: Servo, settings: TwinSettings) -> Estimator:
    """Make the estimator that `settings` name, with a servo as its model.

    The published estimator starts from the previous gap, as printed. The default one gets the trend's prediction, the
    rate at which the gap may grow within the window and, where the window alone shows too little, the encoder's offset.
    """
    settings = settings.on(servo)
    options = settings_of(settings.method, settings.estimator)
    new = stated_machine(settings) if settings.learning.learn and servo.rigid else None

    def estimate(window: Window, expected: Expectation) -> GapEstimate:
        if not isinstance(options, whitened.WhitenedSettings):
            return estimate_gap(window, servo, settings.method, expected.previous, options)
        growing = replace(options, gap_rate=options.gap_rate or expected.gap_rate(settings.trend))
        if new is None or expected.machine is None:
            return estimate_carrying(window, servo, expected.prior, growing, expected.offset, new)
        made = estimate_carrying(window, servo, expected.prior, growing, expected.offset, expected.machine)
        if made.status is not GapStatus.MODEL_MISMATCH:
            return made
        # The machine may have been exchanged: its new numbers are then worth knowing, and nothing else yet.
        other = estimate_carrying(window, servo, None, growing, None, new)
        return replace(made, machine=other.machine) if other.ok else made

    return estimate


def motor_learning_of(servo: Servo, settings: TwinSettings) -> MotorLearning | None:
    """Make the learning of the motor's numbers; None where the settings or the servo's elastic screw rule it out."""
    if not (settings.learning.learn and servo.rigid):
        return None
    known = settings.uncertainty
    # Half-widths within which every value is as likely.
    back_emf, lag = known.k_B / math.sqrt(3.0), known.k_T / math.sqrt(3.0)
    return MotorLearning(
        servo, settings.learning, max(back_emf, settings.learning.motor_floor), max(lag, settings.learning.motor)
    )


def known_gap(gap: SignalLike, duration: float) -> Estimator:
    """Make an estimator that ignores the measurements and returns the true total gap in the middle of the window.

    It shows what the loop could do if estimation were perfect.

    Parameters
    ----------
    gap : number or signal
        rad, total gap.
    duration : float
        s, end of the time for which the signal is evaluated.
    """
    truth = as_nonnegative(gap, duration, "gap", "rad")

    def estimate(window: Window, _expected: Expectation) -> GapEstimate:
        middle = window.start + 0.5 * window.duration
        value = max(0.0, float(truth.value(middle)))
        return GapEstimate(value, 0.0, 0.0, (value, value), GapStatus.OK, middle, method="known")

    return estimate


class DecodedWindow(NamedTuple):
    """A window message with its numbers.

    Attributes
    ----------
    message : messages.WindowMessage
    window : Window or None
        None: the window is unusable.
    problem : str
        Reason for which it is unusable; empty: none.
    """

    message: messages.WindowMessage
    window: Window | None
    problem: str = ""

    @classmethod
    def of(cls, message: messages.WindowMessage) -> DecodedWindow:
        """Decode a message once, for all who need its numbers."""
        try:
            return cls(message, decode_window(message))
        except InvalidInput as error:
            return cls(message, None, str(error))

    def estimate(self, estimator: Estimator, expected: Expectation) -> GapEstimate:
        """Estimate the gap; UNIDENTIFIABLE with the reason where the window is unusable."""
        problem = self.problem
        if self.window is not None:
            try:
                return estimator(self.window, expected)
            except InvalidInput as error:
                problem = str(error)
        return no_estimate(self.message.middle, (problem,), method=UNUSABLE)

    def disturbance(self, observer: Observer | None) -> Disturbance:
        """Estimate input bias and noise; unknown, with the reason, where the window is unusable."""
        if observer is None:
            return NOT_OBSERVED
        problem = self.problem
        if self.window is not None:
            try:
                return observer(self.window)
            except InvalidInput as error:
                problem = str(error)
        return nothing_known(math.nan, problem)

    @property
    def tail(self) -> float | None:
        """Largest tracking error (m) in the last tenth of the window; None where a channel is missing."""
        # Of the numbers as decoded: the edge sends neither channel with a fine part.
        if self.window is None or self.window.reference is None:
            return None
        last = -(-self.message.samples // _TAIL)
        error = np.abs(self.window.position[-last:] - self.window.reference[-last:])
        return messages.finite(float(np.max(error)))

    @property
    def step(self) -> float:
        """Range of the reference within the window, m; 0 where the channel is missing or the reference rests."""
        if self.window is None or self.window.reference is None:
            return 0.0
        size = float(np.ptp(self.window.reference))
        return size if math.isfinite(size) else 0.0


def decode_window(message: messages.WindowMessage) -> Window:
    """Decode the numbers of a message; channels that no estimator uses are left out.

    Raises
    ------
    InvalidInput
        The position is missing, a channel has another unit than the estimators expect, or is too short.
    """
    source = "window {}/{}/{}".format(*message.identity)
    channels = {channel.name: channel for channel in message.channels}
    known = {name: channel for name, channel in channels.items() if name.removesuffix(messages.FINE) in CHANNELS}
    for name, channel in known.items():
        unit = CHANNELS[name.removesuffix(messages.FINE)]
        if channel.unit != unit:
            raise InvalidInput(f"{source}: channel {name} is in {channel.unit!r}; it must be in {unit!r}")
    if "position" not in known:
        raise InvalidInput(f"{source}: channel 'position' is missing; it has {', '.join(sorted(known)) or 'none'}")
    values = {name: decode_channel(channel) for name, channel in known.items() if name in CHANNELS}
    for name in values:
        if name + messages.FINE in known:
            values[name] += decode_channel(known[name + messages.FINE])
    return Window(**values, sample_rate=message.rate, start=message.start, source=source)


def decode_channel(channel: messages.Channel) -> Array:
    """Decode a channel to (n,) samples in its unit, bit for bit those of `messages.unpack_channel`."""
    codes = np.frombuffer(channel.data, dtype="<i2")
    return np.asarray(channel.offset + channel.scale * codes.astype(np.float64))
