"""Exact sampled response of the structure (G2) to the screw's motion, mode by mode.

Between samples the screw's angle is taken as linear (first-order hold), so a step is exact. Each mode runs as a
recurrence of its own, z[i+1] = e z[i] + u[i]: it needs no polynomial, whose coefficients lose their digits when the
sample interval is short, and no product of matrices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from servotwin.hybrid.compiled import bare
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

Complex: TypeAlias = NDArray[np.complex128]
_SMALL = 0.05  # of lambda T, below which the hold's weights come from their series
_TERMS = 12
_DEFECTIVE, _SPLIT = 1e9, 1e-9


@dataclass(frozen=True, eq=False)
class Readout:
    """Output equation of the modes: the real part of gain z, and a direct term.

    Attributes
    ----------
    gain : (modes, 2) array
        Real and imaginary parts.
    direct : float
    """

    gain: Array
    direct: float


@dataclass(frozen=True, eq=False)
class Response:
    """Response of the last mass's position (m) to samples of the screw's angle (rad).

    Attributes
    ----------
    poles : (modes,) complex array
        1/s; one of each conjugate pair.
    decay : (modes, 2) array
        exp(pole T), real and imaginary parts.
    position, velocity : Readout
    interval : float
        T, s.
    static_gain : float
        m/rad, position over angle at rest.
    unseen : float
        s: motions of the screw so late in a window have not reached the last mass; the sum of sqrt(m / k).
    """

    poles: Complex
    decay: Array
    position: Readout
    velocity: Readout
    interval: float
    static_gain: float
    unseen: float

    def respond(self, inputs: Array) -> Array:
        """(k, n) positions (m) for angles (k, n) (rad), from rest at zero one sample before the first.

        Whatever the structure did before is left to `free`, whose columns the true initial state adds.
        """
        return _respond(inputs, self.decay, self.position)

    def velocities(self, inputs: Array) -> Array:
        """(k, n) velocities (m/s) for angles (k, n): the derivative of `respond`, that is minus its change by delay."""
        return _respond(inputs, self.decay, self.velocity)

    def free(self, samples: int) -> Array:
        """(2 modes, n) motions of the unforced structure, real and imaginary part of each mode, of size 1 at first.

        A real pole gives one row; with n masses on a rigid screw there are 2 (n - 1) rows.
        """
        motion = np.exp(np.outer(self.poles, np.arange(samples) * self.interval))
        oscillating = np.abs(self.poles.imag) > 0.0
        return np.vstack([motion.real, motion.imag[oscillating]])


@lru_cache(maxsize=64)
def response(servo: Servo, sample_rate: float) -> Response:
    """The response of a servo's structure at a sample rate (Hz), from its matrices (Eqs 9-13).

    With d = p theta_d and z = x - B_velocity d, z' = A z + (A B_velocity + B_position) d holds no derivative.
    """
    chain, interval = servo.chain(), 1.0 / sample_rate
    poles, shapes = _modes(chain.A)
    drive = np.linalg.solve(shapes, servo.p * (chain.A @ chain.B_velocity + chain.B_position))
    row = chain.C_last
    weight = (row @ shapes) * drive
    # One of each conjugate pair, with twice its weight: the real part of the sum is the same.
    upper = poles.imag >= 0.0
    poles, weight = poles[upper], weight[upper] * np.where(poles[upper].imag > 0.0, 2.0, 1.0)
    direct = servo.p * float(row @ chain.B_velocity + chain.D[-1])
    return Response(
        poles=poles,
        decay=_parts(np.exp(poles * interval)),
        position=_readout(poles, weight, interval, direct),
        velocity=_readout(poles, weight * poles, interval, float(np.sum(weight).real)),
        interval=interval,
        static_gain=direct - float(np.sum(weight / poles).real),
        unseen=float(np.sum(np.sqrt(servo.masses[1:] / servo.stiffnesses[1:]))),
    )


def _modes(matrix: Array) -> tuple[Complex, Complex]:
    """Eigenvalues and eigenvectors; where two modes coincide (critical damping) they are split by a relative 1e-9."""
    poles, shapes = np.linalg.eig(matrix)
    # Coinciding modes have no complete set of eigenvectors.
    if np.linalg.cond(shapes) > _DEFECTIVE:
        pattern = np.linspace(-_SPLIT, _SPLIT, matrix.size).reshape(matrix.shape)
        poles, shapes = np.linalg.eig(matrix * (1.0 + pattern))
    return poles.astype(complex), shapes.astype(complex)


def _readout(poles: Complex, weight: Complex, interval: float, direct: float) -> Readout:
    """Make the readout of the sum of weight z_true + direct u, for z_true[i] = after u[i] + (now + e after) z[i]."""
    now, after = _hold(poles, interval)
    gain = weight * (now + np.exp(poles * interval) * after)
    return Readout(_parts(gain), direct + float(np.sum(weight * after).real))


def _hold(poles: Complex, interval: float) -> tuple[Complex, Complex]:
    """Weights of u[i] and u[i+1] in z[i+1] for z' = pole z + u with u linear in between."""
    x = poles * interval
    series = np.zeros_like(x)
    for order in range(_TERMS, 1, -1):
        series = (1.0 + x * series) / order
    # exp(x) - 1 - x loses its digits for small x; the 1.0 only avoids a division by zero there.
    far = np.where(np.abs(x) < _SMALL, 1.0, x)
    after = np.where(np.abs(x) < _SMALL, series, (np.exp(far) - 1.0 - far) / far**2)
    return np.asarray(interval * (1.0 + x * after - after)), np.asarray(interval * after)


def _parts(values: Complex) -> Array:
    return np.column_stack([values.real, values.imag])


def _respond(inputs: Array, decay: Array, readout: Readout) -> Array:
    out = np.empty(inputs.shape)
    for signal, answer in zip(inputs, out, strict=True):
        run_modes(signal, decay, readout.gain, readout.direct, answer)
    return out


@bare
def run_pair(signal: Array, decay: Array, gain: Array, one: int, two: int, share: float, out: Array) -> None:
    """Add the output of mode `one`, and `share` times that of mode `two`."""
    ar, ai, br, bi = decay[one, 0], decay[one, 1], decay[two, 0], decay[two, 1]
    pr, pi = gain[one, 0], gain[one, 1]
    qr, qi = share * gain[two, 0], share * gain[two, 1]
    xr = xi = yr = yi = 0.0
    for i in range(signal.size):
        out[i] += (pr * xr - pi * xi) + (qr * yr - qi * yi)
        u = signal[i]
        xr, xi = ar * xr - ai * xi + u, ai * xr + ar * xi
        yr, yi = br * yr - bi * yi + u, bi * yr + br * yi


@bare
def run_modes(signal: Array, decay: Array, gain: Array, direct: float, out: Array) -> None:
    """The output (n,) of all modes to a signal (n,); two modes at a time, because one waits for its own products."""
    for i in range(signal.size):
        out[i] = direct * signal[i]
    modes = len(decay)
    for first in range(0, modes - 1, 2):
        run_pair(signal, decay, gain, first, first + 1, 1.0, out)
    if modes % 2 == 1:
        run_pair(signal, decay, gain, modes - 1, modes - 1, 0.0, out)
