"""From a window message to an estimate: decoding, the estimator that a twin's settings name, and one that knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.estimation import whitened
from servotwin.estimation.disturbance import Disturbance, nothing_known
from servotwin.estimation.estimate import GapEstimate, GapStatus, no_estimate
from servotwin.estimation.gap import estimate_gap, settings_of
from servotwin.estimation.offset import estimate_carrying
from servotwin.estimation.window import CHANNELS, Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array, SignalLike, as_nonnegative
from servotwin.redesign.evidence import NOT_OBSERVED
from servotwin.twin.settings import TwinSettings
from servotwin.twin.wear import Expectation

Estimator = Callable[[Window, Expectation], GapEstimate]
"""(window, expectation) -> estimate."""

Observer = Callable[[Window], Disturbance]
"""window -> input bias and noise."""

UNUSABLE = "none"
"""Method of the estimate of a window that no estimator took: no motion would make it better."""

_TAIL = 10  # the last one of so many parts of a window


def estimator_of(servo: Servo, settings: TwinSettings) -> Estimator:
    """The estimator that `settings` name, with a servo as its model.

    The published one starts from the previous gap, as printed. The default one is given the trend's prediction, the
    rate at which the gap may grow within the window and, where the window alone shows too little, the encoder's offset.
    """
    given = settings_of(settings.method, settings.estimator)

    def estimate(window: Window, expected: Expectation) -> GapEstimate:
        if not isinstance(given, whitened.WhitenedSettings):
            return estimate_gap(window, servo, settings.method, expected.previous, given)
        drift = given.gap_rate or expected.gap_rate(settings.trend)
        return estimate_carrying(window, servo, expected.prior, replace(given, gap_rate=drift), expected.offset)

    return estimate


def known_gap(gap: SignalLike, duration: float) -> Estimator:
    """An estimator that ignores the measurements and gives the true total gap in the middle of the window.

    It shows what the loop could do if estimation were perfect.

    Parameters
    ----------
    gap : number or signal
        rad, total gap.
    duration : float
        s, up to when the signal is asked for.
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
        None: it cannot be used.
    problem : str
        Why it cannot be used.
    """

    message: messages.WindowMessage
    window: Window | None
    problem: str = ""

    @classmethod
    def of(cls, message: messages.WindowMessage) -> DecodedWindow:
        """Decode a message, once for all who need its numbers."""
        try:
            return cls(message, decode_window(message))
        except InvalidInput as error:
            return cls(message, None, str(error))

    def estimate(self, estimator: Estimator, expected: Expectation) -> GapEstimate:
        """Estimate the gap; UNIDENTIFIABLE with the reason where the window cannot be used."""
        problem = self.problem
        if self.window is not None:
            try:
                return estimator(self.window, expected)
            except InvalidInput as error:
                problem = str(error)
        return no_estimate(self.message.middle, (problem,), method=UNUSABLE)

    def disturbance(self, observer: Observer | None) -> Disturbance:
        """Estimate input bias and noise; nothing known, with the reason, where the window cannot be used."""
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


def decode_window(message: messages.WindowMessage) -> Window:
    """Decode the numbers of a message; channels that no estimator knows are left out.

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
