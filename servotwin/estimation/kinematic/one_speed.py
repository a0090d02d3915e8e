"""Gap and lag at one speed: there a load that is late by T is behind by speed x T both ways, as behind a gap.

Rests and other speeds tell the two apart, and only where the speed lasts: right behind a change of it, a load that is
late looks like a gap or does not, by the form of its lag, which nobody knows.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from servotwin.estimation.kinematic.close_fit import CloseFit
from servotwin.estimation.kinematic.regression import SPAN, WIND_UP, Regression
from servotwin.estimation.kinematic.strokes import counts_of, noise_of, play_and_side
from servotwin.estimation.kinematic.verdict import LagOfGap, structured
from servotwin.plant.signals import Array

# Shares of half the gap: where a pure delay and a first-order lag differ by less than the first, the form of a lag does
# not matter; better than to the second what a lag does is not known.
_FORM, _KNOWN = 0.1, 0.01
_NOISE = 2.0  # standard deviations of a sample, by which they differ all the same
_DELAYS = 16  # whose mean is a first-order lag
_LEAST = 1e-6  # share of the flanks that a lag leaves, as a root mean square


def lag_of_gap(prepared: Regression, close: CloseFit, lag: float) -> LagOfGap:
    """Find how well speeds and rests tell a fitted gap from a longer lag; `lag` (s) is the one of the fit."""
    speed, half = _speed(prepared), 0.5 * close.gap
    if not (half > 0.0 and speed > 0.0):
        return LagOfGap(speed, 0.0, 0.0)
    delay = half / speed
    late, form = _late(prepared, max(lag, 0.0) + delay)
    # A command that winds up the transmission is no lag.
    others = np.vstack([*(close.values[each] for each in close.places if prepared.names[each] != WIND_UP), late])
    form = _left(form, others)
    steady = _steady(prepared, form, max(lag, 0.0) + delay, half)
    if not steady.any():
        return LagOfGap(speed, delay, np.inf)
    rows = prepared.rows[steady]
    design = prepared._replace(rows=rows, bounds=np.searchsorted(rows, prepared.rows[prepared.bounds]))
    share = structured(design, _left(close.side[steady].astype(float), others[:, steady]))
    doubt = half * float(np.clip(_without_noise(form[steady]) / half, _KNOWN, _FORM))
    return LagOfGap(speed, delay, 2.0 * doubt / max(share, _LEAST))


def _steady(prepared: Regression, form: Array, time: float, half: float) -> Any:
    """(k,) true where the form of a lag does not matter against half a gap; averaged over `time` (s), as long as it."""
    samples = _samples(prepared, time)
    noise = _noise(prepared) / math.sqrt(samples)
    return np.abs(uniform_filter1d(form, samples)) <= max(_FORM * half, _NOISE * noise)


def _samples(prepared: Regression, time: float) -> int:
    """Rows within a time (s), of which at most half a stroke's on the average."""
    rows, strokes = prepared.rows.size, len(prepared.bounds)
    usual = float(np.median(np.diff(prepared.recording.time[prepared.rows]))) if rows > 1 else time
    return max(1, min(round(time / usual), rows // (2 * max(strokes, 1))))


def _noise(prepared: Regression) -> float:
    """Standard deviation of one sample of the motor, by its counts and its noise."""
    return math.hypot(counts_of(prepared.recording)[0] / math.sqrt(12.0), noise_of(prepared.recording.motor))


def _without_noise(values: Array) -> float:
    """Root mean square, what differs from sample to sample taken off."""
    white = 0.5 * float(np.mean(np.diff(values) ** 2)) if values.size > 1 else 0.0
    return math.sqrt(max(float(np.mean(values**2)) - white, 0.0))


def _speed(prepared: Regression) -> float:
    """Mean speed of the motor over its way, its counts left out."""
    recording = prepared.recording
    side = np.zeros(recording.motor.size, dtype=np.int8)
    smooth = play_and_side(recording.motor, 2.0 * counts_of(recording)[0], side)
    steps, times = np.abs(smooth[SPAN:] - smooth[:-SPAN]), recording.time[SPAN:] - recording.time[:-SPAN]
    return float(np.sum(steps**2 / times) / max(np.sum(steps), np.finfo(float).tiny))


def _late(prepared: Regression, lag: float) -> tuple[Array, Array]:
    """Way that a first-order lag leaves a load behind its motor, and how much more a delay does, (k,) each."""
    time, motor = prepared.recording.time, prepared.recording.motor
    delays = -np.log1p(-(np.arange(_DELAYS) + 0.5) / _DELAYS)
    delayed, *others = (np.interp(time[prepared.rows] - lag * x, time, motor) for x in (1.0, *delays / delays.mean()))
    lagging = np.mean(others, axis=0)
    return motor[prepared.rows] - lagging, lagging - delayed


def _left(values: Array, others: Array) -> Array:
    """Remainder of values (k,) beside columns (p, k)."""
    scale = np.sqrt(np.sum(others**2, axis=1))
    unit = others / np.where(scale > 0.0, scale, 1.0)[:, None]
    return values - np.linalg.lstsq(unit @ unit.T, unit @ values, rcond=1e-12)[0] @ unit
