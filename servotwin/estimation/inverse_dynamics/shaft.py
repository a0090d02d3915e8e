"""Frequency response from motor to load, and the shaft that explains it: resonance, damping and delay.

Of positions the response of a load on an elastic shaft is (2 zeta s / w + 1) / (s^2 / w^2 + 2 zeta s / w + 1), w its
resonance with the motor held. Frequencies count by their coherence; the highest ones, where noise rules, hardly do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, signal

from servotwin.estimation.estimate import NORMAL_95
from servotwin.estimation.inverse_dynamics.conditioning import RegressionBand, motion_of
from servotwin.estimation.inverse_dynamics.fit import ParameterFit, cycle_time, least_squares, rows_of
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

SPLIT = ("load_inertia", "motor_inertia", "viscous", "coulomb", "offset")
"""Parameters of a drive with its load on a shaft."""

_COHERENT = 0.8  # least coherence of a frequency that counts
_SEGMENTS = 16  # half overlapping, of the average
_LEAST = 8  # frequencies
_LEAKAGE = 0.02  # of the response: what the segments' window smears
_BEYOND = 1.5  # of the resonance: corner of the filter that shows both inertias
_NO_PEAK = math.sqrt(0.5)  # damping ratio from which on a response has no peak
_EVIDENT = 4.0  # standard deviations by which the compliance must differ from none


@dataclass(frozen=True, eq=False)
class ShaftResponse:
    """Frequency response from motor to load and its fit.

    Attributes
    ----------
    frequency : (f,) array
        Hz.
    response : (f,) complex array
        Load over motor, both at the load.
    coherence : (f,) array
    resonance, resonance_std : float
        Hz, of the load with the motor held; inf: the log shows no elasticity.
    damping, damping_std : float
        Ratio.
    delay, delay_std : float
        s, by which the load's encoder is later than the motor's; NaN: the load follows the motor in another way.
    """

    frequency: Array
    response: Array
    coherence: Array
    resonance: float
    resonance_std: float
    damping: float
    damping_std: float
    delay: float
    delay_std: float

    @property
    def highest(self) -> float:
        """Highest coherent frequency, Hz."""
        return float(self.frequency[self.coherence > _COHERENT].max(initial=0.0))

    def stiffness(self, load: float) -> float:
        """Stiffness of the shaft for a load's mass or inertia, N/m (rotary: N m/rad)."""
        return load * (2.0 * math.pi * self.resonance) ** 2

    def shaft_damping(self, load: float) -> float:
        """Damping of the shaft for a load's mass or inertia, N s/m (rotary: N m s/rad)."""
        return 2.0 * self.damping * load * 2.0 * math.pi * self.resonance


def shaft_response(recording: DriveRecording) -> ShaftResponse | None:
    """Estimate the response and fit it; None: no load encoder, or too few coherent frequencies."""
    if recording.load is None:
        return None
    rate = recording.rate
    # Accelerations: their spectra are flatter than those of positions, and leak less.
    motor, load = (np.diff(each, 2) for each in (recording.position, recording.load))
    size = max(64, 2 * motor.size // (_SEGMENTS + 1))
    frequency, motor_power = signal.welch(motor, rate, nperseg=size)
    _, load_power = signal.welch(load, rate, nperseg=size)
    _, cross = signal.csd(motor, load, rate, nperseg=size)
    coherence = np.abs(cross) ** 2 / np.maximum(motor_power * load_power, np.finfo(float).tiny)
    response = cross / np.maximum(motor_power, np.finfo(float).tiny)
    used = (coherence > _COHERENT) & (frequency > 0.0) & (frequency < 0.4 * rate)
    if used.sum() < _LEAST:
        return None
    # Bendat and Piersol: standard deviation of a response's modulus, and of its phase.
    spread = np.abs(response) * np.sqrt((1.0 - coherence) / (2.0 * _SEGMENTS * coherence)) + _LEAKAGE * np.abs(response)
    fit = _fitted(frequency[used], response[used], spread[used])
    return ShaftResponse(frequency, response, coherence, *fit)


def _fitted(frequency: Array, response: Array, spread: Array) -> tuple[float, float, float, float, float, float]:
    """Resonance, damping ratio and delay with their standard deviations."""
    s = 2j * math.pi * frequency
    top = 2.0 * math.pi * float(frequency.max())

    def modelled(compliance: float, loss: float, delay: float) -> Array:
        """Compliance 1 / w^2 over that at the highest frequency, damping 2 zeta / w likewise, delay in its periods."""
        damped = 1.0 + loss * s / top
        return np.asarray(damped / (damped + compliance * (s / top) ** 2) * np.exp(-s * delay / top))

    def residuals(values: Array) -> Array:
        left = (response - modelled(*values)) / spread
        return np.concatenate([left.real, left.imag])

    starts = [np.array([each, 0.1, 0.0]) for each in (0.05, 0.5, 2.0, 8.0)]
    best = min(
        (optimize.least_squares(residuals, start, x_scale=[0.1, 0.1, 0.1]) for start in starts), key=lambda r: r.cost
    )
    compliance, loss, delay = best.x
    scale = max(1.0, 2.0 * best.cost / max(2 * frequency.size - 3, 1))
    covariance = scale * np.linalg.pinv(best.jac.T @ best.jac)
    deviations = np.sqrt(np.diag(covariance))
    delay, delay_std = float(delay / top), float(deviations[2] / top)
    # A resonance beyond the frequencies that count is extrapolated: a gap's response looks like its beginning.
    if compliance < max(_EVIDENT * deviations[0], 1.0):
        return math.inf, math.inf, math.nan, math.inf, delay, delay_std
    omega = top / math.sqrt(compliance)
    zeta, zeta_std = 0.5 * loss * omega / top, 0.5 * omega / top * float(deviations[1])
    if not -NORMAL_95 * zeta_std < zeta < _NO_PEAK:  # three masses, or a belt that slips
        return math.inf, math.inf, math.nan, math.inf, math.nan, math.inf
    return (
        omega / (2.0 * math.pi),
        0.5 * omega / (2.0 * math.pi) * float(deviations[0]) / compliance,
        max(float(zeta), 0.0),
        zeta_std,
        delay,
        delay_std,
    )


def split_inertia(recording: DriveRecording, band: RegressionBand, shaft: ShaftResponse) -> ParameterFit | None:
    """Fit the inertias before and behind the shaft, from both accelerations.

    None: there is no resonance, it is too fast, or an inertia is not positive for sure.
    """
    corner = _BEYOND * shaft.resonance
    if recording.load is None or not corner < 0.2 * recording.rate:
        return None
    wide = band._replace(corner=max(corner, band.corner))
    wide = wide._replace(decimation=max(1, int(recording.rate / (2.5 * wide.corner))))
    motor, load = (motion_of(each, recording.rate, wide) for each in (recording.position, recording.load))
    later = shaft.delay * recording.rate
    places = np.arange(motor.speed.size)
    behind = np.interp(places + later, places, load.acceleration)
    # A controller holds its command for a sample: around the position's instant acts the mean of two.
    held = 0.5 * (recording.force + np.concatenate([recording.force[:1], recording.force[:-1]]))
    rows = rows_of(replace(recording, force=held), motor, wide, cycle_time(motor), behind[:, None])
    fit = least_squares(SPLIT, np.column_stack([rows.extra, rows.design[:, : len(SPLIT) - 1]]), rows)
    sure = all(fit[name] > fit.half_width(name) for name in ("load_inertia", "motor_inertia"))
    return fit if sure else None
