"""Filtering of a recording to the rows of a regression: the band is that of the motion, as far as noise allows.

Command and regressors pass the same zero-phase low-pass, which leaves their relation as it is and takes off what lies
beyond the motion; only then are they decimated. The sign of the speed, which no filter commutes with, is taken
before that filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import signal

from servotwin.estimation.inverse_dynamics.recording import DriveRecording, Mask
from servotwin.plant.signals import Array

_ORDER = 4  # of the Butterworth filters, each applied forth and back
_SHARE = 0.99  # of the acceleration's power lies within the motion's band
_BEYOND = 1.5  # corner of the filter over the motion's band
_NOISE = 0.01  # largest power of the noise's acceleration, of the motion's
_LIKELY = 0.25  # of the sample rate: motion beyond is none, what is there is noise
_ABOVE = 4.0  # times the noise: what counts as motion
_FINE = 5.0  # corner of the filter before the sign of the speed is taken, over that of the regression
_HIGHEST = 0.4  # of the sample rate: highest corner
_EDGE = 2.0  # periods of the corner that a filter needs to forget the ends
_REST = 2.0  # periods of the corner: a longer standstill is no reversal
_SEGMENTS = 8  # of a spectrum's average
_LARGEST = 0.99  # quantile that counts as the largest speed
_KEPT = 0.99  # share of usable samples below a row's filter
LONGEST = 2**18
"""Samples of a log that are fitted with many regressors at once."""


class RegressionBand(NamedTuple):
    """RegressionBand of a regression.

    Attributes
    ----------
    motion : float
        Hz, below which 99 % of the acceleration's power lie.
    corner : float
        Hz, of the low-pass on all signals.
    decimation : int
    noise : float
        Density of the position's noise, unit^2/Hz.
    """

    motion: float
    corner: float
    decimation: int
    noise: float


@dataclass(frozen=True, eq=False)
class DriveMotion:
    """Derivatives of a position and the sign of its speed, at the rate of the recording.

    Attributes
    ----------
    speed, acceleration, side : (n,) array
    resting : (n,) bool array
        True in standstills that are longer than a reversal.
    rate : float
        Hz.
    """

    speed: Array
    acceleration: Array
    side: Array
    resting: Mask
    rate: float

    @property
    def seconds(self) -> float:
        """Duration of what moves, s."""
        return float(np.sum(~self.resting)) / self.rate

    @property
    def speeds(self) -> Array:
        """(2,) mean and largest speed of what moves; the largest is that which a hundredth of it exceeds."""
        fast = np.abs(self.speed[~self.resting])
        return np.array([fast.mean(), np.quantile(fast, _LARGEST)])


def band_of(recording: DriveRecording) -> RegressionBand:
    """Choose the band from the spectrum of the acceleration."""
    rate = recording.rate
    second = np.diff(recording.position, 2) * rate**2
    size = min(second.size, max(256, second.size // _SEGMENTS))
    frequency, power = signal.welch(second, rate, nperseg=size)
    gain = (2.0 * rate * np.sin(math.pi * frequency / rate)) ** 4
    # What an encoder interpolates wrongly stands out of the noise by single lines: the mean counts them.
    top = frequency > _LIKELY * rate
    noise = float(power[top].sum() / gain[top].sum())
    frequency, power, gain = frequency[~top], power[~top], gain[~top]
    # Close to the noise its own chance would count as motion.
    excess = np.where(power > _ABOVE * noise * gain, power - noise * gain, 0.0)
    within = np.cumsum(excess)
    motion = float(frequency[np.searchsorted(within, _SHARE * within[-1])])
    noisy = np.flatnonzero(np.cumsum(noise * gain) > _NOISE * np.maximum(within, np.finfo(float).tiny))
    # Below the motion's own band there is only drift of the spectrum's estimate.
    noisy = noisy[frequency[noisy] > 0.1 * motion]
    quiet = float(frequency[noisy[0]]) if noisy.size else math.inf
    corner = min(_BEYOND * motion, max(quiet, 0.5 * motion), 0.5 * _HIGHEST * rate)
    corner = max(corner, 4.0 / recording.duration)
    return RegressionBand(motion, corner, max(1, int(rate / (2.5 * corner))), noise)


def motion_of(position: Array, rate: float, band: RegressionBand) -> DriveMotion:
    """Derive speed and acceleration, and find standstills."""
    fine = min(_FINE * band.corner, _HIGHEST * rate)
    smooth = low_passed(position, fine, rate)
    speed = np.gradient(smooth, 1.0 / rate)
    side = np.sign(speed)
    # Noise of the speed behind the fine filter.
    slow = 4.0 * math.sqrt(band.noise * (2.0 * math.pi) ** 2 * fine**3 / 3.0)
    slow = max(slow, 1e-4 * float(np.abs(speed).max()))
    resting = _long(np.abs(speed) < slow, _REST * rate / band.corner)
    return DriveMotion(speed, np.gradient(speed, 1.0 / rate), side, resting, rate)


def busiest(recording: DriveRecording, motion: DriveMotion) -> tuple[DriveRecording, DriveMotion]:
    """The stretch of at most `LONGEST` samples with most motion: many regressors of a long log fill the memory."""
    size = recording.position.size
    if size <= LONGEST:
        return recording, motion
    moved = np.concatenate([[0], np.cumsum(~motion.resting)])
    begin = int(np.argmax(moved[LONGEST:] - moved[:-LONGEST]))

    def cut(values: Any) -> Any:
        return values[begin : begin + LONGEST] if isinstance(values, np.ndarray) and values.size == size else values

    return (
        replace(recording, **{each.name: cut(getattr(recording, each.name)) for each in fields(recording)}),
        replace(motion, **{each.name: cut(getattr(motion, each.name)) for each in fields(motion)}),
    )


def filtered_rows(
    columns: Array, moving: Mask, present: Mask, rate: float, band: RegressionBand
) -> tuple[Array, Array]:
    """Low-pass and decimate (n, c) columns; return the rows of moving, present samples and their times (s)."""
    kept = low_passed(np.column_stack([columns, moving.astype(float)]), band.corner, rate)
    edge = min(int(_EDGE * rate / band.corner), len(kept) // 4)
    places = np.arange(edge, len(kept) - edge, band.decimation)
    rows = kept[places]
    good = rows[:, -1] > _KEPT
    # What was put in place of missing samples rings in the filter.
    if not present.all():
        near = np.convolve(~present, np.ones(2 * edge + 1), mode="same") > 0.5
        good &= ~near[places]
    return rows[good, :-1], places[good] / rate


def low_passed(columns: Array, corner: float, rate: float) -> Array:
    """Butterworth low-pass without phase, along the first axis."""
    sections = signal.butter(_ORDER, min(corner, _HIGHEST * rate), fs=rate, output="sos")
    pad = min(len(columns) - 1, int(3.0 * rate / corner))
    return np.asarray(signal.sosfiltfilt(sections, columns, axis=0, padlen=pad))


def _long(mask: Mask, least: float) -> Mask:
    """The parts of a mask that last for at least so many samples."""
    changes = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    result = np.zeros(mask.size, dtype=np.bool_)
    for begin, end in changes.reshape(-1, 2):
        result[begin:end] = end - begin >= least
    return result
