"""Cyclic transmission error: periods of the motor's angle with which the load deviates."""

from __future__ import annotations

import numpy as np

from servotwin.plant.signals import Array

_BINS = 2048
_PERIODS = 2  # looked for at most
_SHARE = 0.1  # of the variance over the angle, which a period must explain


def periods(angle: Array, residual: Array) -> tuple[float, ...]:
    """Periods of the residual over the motor's angle, in the angle's unit, the strongest first.

    Parameters
    ----------
    angle, residual : (k,) array
        Position of the play's output and what the model leaves of the load.
    """
    reach = float(np.ptp(angle))
    if not reach > 0.0:
        return ()
    place = np.minimum(((angle - angle.min()) / reach * _BINS).astype(int), _BINS - 1)
    count = np.bincount(place, minlength=_BINS)
    mean = np.bincount(place, weights=residual, minlength=_BINS) / np.maximum(count, 1)
    found: list[float] = []
    kept, centre = count > 0, (np.arange(_BINS) + 0.5) / _BINS
    left = mean[kept]
    if left.size < 32:
        return ()
    # From two periods within the travel on, in quarters of a cycle, to eight bins a period.
    frequencies = np.arange(2.0, _BINS / 8, 0.25)
    for _ in range(_PERIODS):
        phases = np.exp(-2j * np.pi * np.outer(frequencies, centre[kept]))
        power = np.abs(phases @ (left - left.mean())) ** 2 * 2.0 / left.size
        best = int(np.argmax(power))
        if power[best] < _SHARE * np.sum((left - left.mean()) ** 2) or power[best] < 12.0 * np.median(power):
            break
        found.append(reach / frequencies[best])
        basis = np.array([phases[best].real, phases[best].imag, np.ones(left.size)]).T
        left = left - basis @ np.linalg.lstsq(basis, left, rcond=None)[0]
    return tuple(found)
