"""Estimation in the twin: decoding of a window, and choice of the estimator. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from servotwin import messages
from servotwin.control.gains import with_gains
from servotwin.control.laws import AnyController
from servotwin.errors import InvalidInput
from servotwin.estimation import motor_side, output_error, whitened
from servotwin.estimation.axis_model import servo_for
from servotwin.estimation.commanded_angle import begins_anew, check_motor_angle
from servotwin.estimation.controller import ControllerComparison, compare_controller
from servotwin.estimation.disturbance import Disturbance, nothing_known
from servotwin.estimation.estimate import GapEstimate, GapStatus, no_estimate
from servotwin.estimation.gap import default_method, estimate_gap, options_for
from servotwin.estimation.late_window import prompt_window
from servotwin.estimation.learning.machine import nameplate
from servotwin.estimation.learning.motor import MotorLearning
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.output_error.fit import Search
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import CHANNELS, Window
from servotwin.messages import Setting
from servotwin.plant.actuator import DcMotor
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.plants import Plant, prompt_plant
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array, SignalLike, as_nonnegative
from servotwin.redesign.policy import NOT_OBSERVED
from servotwin.twin.settings import TwinSettings

Estimator = Callable[[Window, Expectation], GapEstimate]
"""(window, expectation) -> estimate."""

Observer = Callable[[Window], Disturbance]
"""window -> input bias and noise."""

OTHER_CONTROLLER = 2
"""Windows in a row under another controller than stated that raise an alarm: a change of setting may lie in one."""

UNUSABLE = "none"
"""Method of the estimate of an unusable window; a probing move would not improve it."""

_TAIL = 10  # the last one of so many parts of a window
_LATE, _FARTHEST, _NEAR = 4, 0.8, 0.1  # the same of what comes last; of the largest way, at first; of that, at last


def stated_machine(settings: TwinSettings) -> FactorPrior:
    """Make the prior that the nameplate states of the machine."""
    known = settings.uncertainty
    return nameplate(settings.learning, known.k, known.c, known.m)


def known_machine(servo: Plant, settings: TwinSettings) -> FactorPrior | None:
    """Knowledge of a machine before its first window; None: it is not learnt, and keeps the numbers of its model.

    Of one mass behind a rigid transmission only the ratio shows; it is known better where nothing is stated of it. A
    shaft that is free in the gap begins with what its own estimate assumes where nothing is learnt. A load with
    friction behind a screw that the gap holds is not learnt.
    """
    known, own = stated_machine(settings), output_error.OutputErrorSettings()
    pitch = min(known.pitch[1], own.ratio)
    free = servo.backlash_kind is BacklashKind.FREE
    if not settings.learning.learn or servo.at_motor:
        return None
    if free:
        return FactorPrior.of_spreads(own.stiffness, own.damping, pitch, own.mass_ratio)
    if servo_for(servo) is not None:
        return known
    return known.with_pitch(0.0, pitch) if output_error.follows(servo) else None


def estimator_of(servo: Plant, settings: TwinSettings) -> Estimator:
    """Make the estimator that `settings` name, with a servo as its model.

    The published estimator starts from the previous gap, as printed. The default one gets the trend's prediction, the
    rate at which the gap may grow within the window and, where the window alone shows too little, the encoder's offset.
    """
    settings, version, read = settings.on(servo), servo.version, servo
    check_motor_angle(servo)
    servo = prompt_plant(servo)
    model = servo_for(servo)
    # A file without a table [estimator] gives the defaults of its method.
    stated = settings.estimator not in (None, whitened.WhitenedSettings()) or settings.method != whitened.METHOD
    if model is None and stated:
        raise InvalidInput(
            f"[twin] method = {settings.method!r} and its settings: are for axes that are held in the gap and have "
            "two masses or more, without friction of the load; leave them out for this axis"
        )
    own = default_method(servo)
    if servo.at_motor:
        # Its windows hold the motor's angle twice.
        motor_side.check_reaction(servo)
        own, model = motor_side.METHOD, None
    options = options_for(servo, settings.method, settings.estimator)
    new = known_machine(servo, settings)
    # The methods that settings name are those of a servo.
    fitted = _fits_of_axis(servo, own, settings) if model is None else _fits_of_servo(model, options, settings)

    def of_model(window: Window, expected: Expectation) -> GapEstimate:
        window = prompt_window(window, read)
        if model is not None and not isinstance(options, whitened.WhitenedSettings):
            return estimate_gap(window, servo, settings.method, expected.previous, options)
        if new is None or expected.machine is None:
            return fitted(window, expected, new)
        made = fitted(window, expected, expected.machine)
        if made.status is not GapStatus.MODEL_MISMATCH:
            return made
        # The machine may have been exchanged: its new numbers are then worth knowing, and nothing else yet.
        other = fitted(window, expected, new, afresh=True)
        return replace(made, machine=other.machine) if other.ok else made

    def estimate(window: Window, expected: Expectation) -> GapEstimate:
        made = of_model(window, expected)
        if begins_anew(read):
            # Places of one window are none of the next.
            made = replace(made, offset=None, contact=None)
        return replace(made, model_version=version)

    return of_model if model is servo else estimate


class _Fits(Protocol):
    """Estimate of a window with what is known of the machine; `afresh`: without what is expected of the gap."""

    def __call__(
        self, window: Window, expected: Expectation, machine: FactorPrior | None, *, afresh: bool = False
    ) -> GapEstimate: ...


def _fits_of_axis(servo: Plant, method: str, settings: TwinSettings) -> _Fits:
    """Estimates of an axis that no servo stands for."""

    def fitted(
        window: Window, expected: Expectation, machine: FactorPrior | None, *, afresh: bool = False
    ) -> GapEstimate:
        prior, contact = (None, None) if afresh else (expected.prior, expected.contact)
        chosen = _worn(method, expected, settings)
        if isinstance(chosen, motor_side.MotorSideSettings):
            return estimate_gap(window, servo, method, prior, chosen)
        return output_error.estimate(window, servo, prior, chosen, machine, contact)

    return fitted


def _fits_of_servo(model: Servo, options: object, settings: TwinSettings) -> _Fits:
    """Whitened estimates of a servo, or of an axis that it stands for."""

    def fitted(
        window: Window, expected: Expectation, machine: FactorPrior | None, *, afresh: bool = False
    ) -> GapEstimate:
        assert isinstance(options, whitened.WhitenedSettings)
        growing = replace(options, gap_rate=options.gap_rate or expected.gap_rate(settings.trend))
        prior, offset, contact = (None, None, None) if afresh else (expected.prior, expected.offset, expected.contact)
        return whitened.estimate_carrying(window, model, prior, growing, offset, machine, contact)

    return fitted


def own_fit(window: Window, servo: Axis, settings: TwinSettings, expected: Expectation) -> Search:
    """Fit a prompt window as the estimator of an axis does that has no servo as its model; raises InvalidInput."""
    settings = settings.on(servo)
    if servo.at_motor:
        motor = motor_side.MotorSideSettings(gap_rate=expected.gap_rate(settings.trend))
        return motor_side.fit(window, servo, expected.prior, motor)
    own = output_error.OutputErrorSettings(gap_rate=expected.gap_rate(settings.trend))
    return output_error.fit(window, servo, expected.prior, own, expected.machine or known_machine(servo, settings))


def _worn(
    method: str, expected: Expectation, settings: TwinSettings
) -> output_error.OutputErrorSettings | motor_side.MotorSideSettings:
    """Settings of an axis's own estimator for a gap that grows as the trend says, or as was assumed of it before."""
    rate = expected.gap_rate(settings.trend)
    if method == motor_side.METHOD:
        return motor_side.MotorSideSettings(gap_rate=rate)
    return output_error.OutputErrorSettings(friction=settings.uncertainty.own_friction, gap_rate=rate)


def motor_learning_of(servo: Plant, settings: TwinSettings) -> MotorLearning | None:
    """Make the learning of the motor's numbers; None where the settings, an elastic screw, a late encoder or another
    actuator than a DC motor rule it out."""
    model = servo_for(servo)
    drives = isinstance(servo, Servo) or isinstance(servo.actuator, DcMotor)
    if not settings.learning.learn or model is None or not (model.rigid and drives) or servo.sensors.motor.delay:
        return None
    known = settings.uncertainty
    # Half-widths within which every value is as likely.
    back_emf, lag = known.k_B / math.sqrt(3.0), known.k_T / math.sqrt(3.0)
    back_emf, lag = max(back_emf, settings.learning.motor_floor), max(lag, settings.learning.motor)
    return MotorLearning(model, settings.learning, back_emf, lag, servo.command_limit)


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

    def compare_controller(
        self, controller: AnyController | None, stated: Setting | None
    ) -> ControllerComparison | None:
        """Compare the voltage with that of a servo's controller with the gains and the dead zone stated for the window.

        None: one of the two is not known, or the window does not tell.
        """
        if controller is None or stated is None or self.window is None:
            return None
        return compare_controller(self.window, with_gains(controller, stated.gains), stated.tolerance)

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

    @property
    def way_to_rest(self) -> float:
        """Way from the first sample to where the position comes to rest, m, as after a step; 0 where it does not."""
        if self.window is None:
            return 0.0
        left = np.abs(self.window.position - self.window.position[-1])
        way, late = float(left[0]), left[-(left.size // _LATE) :]
        arrived = way >= _FARTHEST * float(left.max()) and float(late.max()) <= _NEAR * way
        return way if arrived else 0.0


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
