"""How a twin estimates: the method that its settings name, told what is expected of the window."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from servotwin.errors import InvalidInput
from servotwin.estimation import whitened
from servotwin.estimation.disturbance import Disturbance, nothing_known
from servotwin.estimation.estimate import GapEstimate, no_estimate
from servotwin.estimation.gap import estimate_gap, settings_of
from servotwin.estimation.offset import estimate_carrying
from servotwin.estimation.window import Window
from servotwin.messages import Window as WindowMessage
from servotwin.plant.servo import Servo
from servotwin.redesign.evidence import UNASKED
from servotwin.twin.decode import decode_window
from servotwin.twin.settings import TwinSettings
from servotwin.twin.wear import Expectation

Estimator = Callable[[Window, Expectation], GapEstimate]
"""(window, what is known before it) -> estimate."""

Observer = Callable[[Window], Disturbance]
"""window -> input bias and noise."""

UNUSABLE = "none"
"""Method of what is stated where no estimator took the window: no motion would make it better."""


def estimator_of(servo: Servo, settings: TwinSettings) -> Estimator:
    """The estimator that `settings` name, with a servo as its model.

    The published one starts from the previous gap, as printed. The default one is told what the trend predicts, how
    fast the gap may grow within the window and, where the window alone shows too little, the encoder's offset.
    """
    given = settings_of(settings.method, settings.estimator)

    def estimate(window: Window, expected: Expectation) -> GapEstimate:
        if not isinstance(given, whitened.WhitenedSettings):
            return estimate_gap(window, servo, settings.method, expected.previous, given)
        drift = given.gap_rate or expected.gap_rate(settings.trend)
        return estimate_carrying(window, servo, expected.prior, replace(given, gap_rate=drift), expected.offset)

    return estimate


def estimate_from(message: WindowMessage, estimator: Estimator, expected: Expectation) -> GapEstimate:
    """What a window says about the gap; where it cannot be used at all, UNIDENTIFIABLE and why."""
    try:
        return estimator(decode_window(message), expected)
    except InvalidInput as error:
        return no_estimate(message.middle, (str(error),), method=UNUSABLE)


def observed(message: WindowMessage, observer: Observer | None) -> Disturbance:
    """What a window says about input bias and noise; where it cannot be used at all, nothing and why."""
    if observer is None:
        return UNASKED
    try:
        return observer(decode_window(message))
    except InvalidInput as error:
        return nothing_known(math.nan, str(error))
