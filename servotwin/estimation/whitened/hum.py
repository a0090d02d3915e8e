"""Hum in a residual: sines that a short autoregression would model as noise, at the cost of the noise's level.

An autoregression follows a sine only with a high order. One that is learnt from a second of residual then errs in the
noise's level in the band that shows the gap, and a window whose level came out too low is the one that is accepted.
"""

from __future__ import annotations

import math

import numpy as np

from servotwin.estimation.core.least_squares import orthonormal, project_out
from servotwin.estimation.core.whitening import criterion
from servotwin.plant.signals import Array

_MOST = 3  # sines: mains and two harmonics
_SURE = 30.0  # gain in twice the logarithm of the likelihood, beyond what three parameters cost
_FINER = 8  # frequencies tried, at least, for each that a window tells apart
_PARAMETERS = 3.0  # of a sine: frequency, amplitude and phase


def sines(frequencies: tuple[float, ...], samples: int) -> Array:
    """(2 f, m) sines and cosines of frequencies (rad per sample)."""
    if not frequencies:
        return np.empty((0, samples))
    phase = np.outer(frequencies, np.arange(samples))
    return np.vstack([np.sin(phase), np.cos(phase)])


def hum(residual: Array, order: int, least: float) -> tuple[float, ...]:
    """Frequencies (rad per sample) of the sines in a residual (m,) that make it far likelier.

    Parameters
    ----------
    residual : (m,) array
    order : int
        Largest one of the noise's autoregression.
    least : float
        rad per sample: below it a sine may be the structure's own motion.
    """
    found: tuple[float, ...] = ()
    if not least < math.pi or not np.any(residual):
        return found
    before = criterion(residual, order)
    while len(found) < _MOST:
        tried = (*found, _loudest(_without(residual, found), least))
        after = criterion(_without(residual, tried), order) + 2.0 * _PARAMETERS
        if before - after < _SURE:
            break
        found, before = tried, after
    return found


def _without(residual: Array, frequencies: tuple[float, ...]) -> Array:
    """A residual (m,) less the sines of some frequencies (rad per sample)."""
    return project_out(orthonormal(sines(frequencies, residual.size)), residual[None])[0] if frequencies else residual


def _loudest(residual: Array, least: float) -> float:
    """Frequency (rad per sample) from `least` on at which a residual (m,) has most power."""
    # A power of two: a transform of a length with large prime factors takes ten times as long.
    power = np.abs(np.fft.rfft(residual, 2 ** math.ceil(math.log2(_FINER * residual.size)))) ** 2
    step = math.pi / (power.size - 1)
    power[: math.ceil(least / step)] = 0.0
    top = int(np.argmax(power[1:-1])) + 1
    low, middle, high = power[top - 1 : top + 2]
    bend = low - 2.0 * middle + high
    return step * (top + (0.5 * float((low - high) / bend) if bend < 0.0 else 0.0))
