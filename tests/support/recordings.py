"""Recordings of a motor and a load behind a gap, as real logs have them."""

from __future__ import annotations

import numpy as np

from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.plant.backlash import play


def swings(seconds=20.0, rate=500.0, speed=1.0):
    """Times, and a motor that swings through different strokes."""
    time = np.arange(0.0, seconds, 1.0 / rate)
    return time, 3.0 * np.sin(np.pi * speed * time) + 1.3 * np.sin(5.2 * speed * time + 1.0)


def recording(gap=0.05, ratio=0.1, lag=0.0, noise=2e-5, count=1e-3, error=None, seed=1, **motion):
    """A recording; `error` is the transmission error as a function of the play's output, in the load's unit."""
    time, motor = swings(**motion)
    output = play(np.interp(time - lag, time, motor), gap)
    load = ratio * output + 0.03 + noise * np.random.default_rng(seed).standard_normal(time.size)
    if error is not None:
        load = load + error(output)
    return EncoderRecording(time, np.round(motor / count) * count, load)
