"""What the edge is given to tell whether a window is worth sending: the structure's response in plain floats."""

from __future__ import annotations

import numpy as np

from servotwin.edge.novelty.model import Mode, NoveltyModel
from servotwin.errors import InvalidInput
from servotwin.estimation.core.response import response
from servotwin.plant.servo import Servo

PER_PERIOD = 9.0
"""Samples that are judged per period of the structure's fastest mode: the load moves no faster, and what the sensor
adds above is left out. With 36 the spread is the same and an autoregression of it needs four times the order."""


def model_of(servo: Servo, sample_rate: float) -> NoveltyModel:
    """The structure at a sample rate (Hz), as the edge needs it.

    Raises
    ------
    InvalidInput
        The screw is not rigid: then the load acts back, and its angle is no function of the motor's.
    """
    if not servo.rigid:
        raise InvalidInput(f"servo k_d = {servo.k_d!r} N/m: novelty at the edge needs a rigid screw")
    known = response(servo, sample_rate)
    fastest = float(np.abs(known.poles).max()) / (2.0 * np.pi)
    modes = tuple(
        Mode(complex(*decay), complex(*gain))
        for decay, gain in zip(known.decay.tolist(), known.position.gain.tolist(), strict=True)
    )
    factor = max(1, round(sample_rate / (PER_PERIOD * fastest)))
    return NoveltyModel(sample_rate, modes, known.position.direct, known.static_gain, known.unseen, factor)
