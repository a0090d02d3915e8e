"""Exact sampled response of the structure (G2) to the screw's motion, mode by mode.

Between samples the screw's angle is taken as linear (first-order hold), so a step is exact. Each mode runs as a
recurrence of its own, z[i+1] = e z[i] + u[i]: it needs no polynomial, whose coefficients lose their digits when the
sample interval is short, and no product of matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias

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
        return self.real_parts(geometric(self.poles * self.interval, samples))

    def real_parts(self, motions: Complex) -> Array:
        """(2 modes, n) real and imaginary parts of motions (modes, n) of the modes; those of a real pole are real."""
        return np.vstack([motions.real, motions.imag[np.abs(self.poles.imag) > 0.0]])


def geometric(exponents: Complex, samples: int) -> Complex:
    """(modes, n) exp(exponent i), i = 0, 1, ...: a product of two exponentials, of which there are few."""
    width = max(1, math.isqrt(samples))
    height = -(-samples // width)
    far, near = (np.exp(np.outer(exponents, steps)) for steps in (width * np.arange(height), np.arange(width)))
    return np.asarray((far[:, :, None] * near[:, None, :]).reshape(exponents.size, -1)[:, :samples])


class Structures(NamedTuple):
    """Some structures z' = A z + drive u, y = row z + direct u, of the same size.

    Attributes
    ----------
    A : (s, N, N) array
    drive : (s, N) array
    row : (N,) array
    direct, unseen : (s,) arrays
        `unseen` as in `Response`.
    """

    A: Array
    drive: Array
    row: Array
    direct: Array
    unseen: Array

    def responses(self, sample_rate: float) -> list[Response]:
        """The response of each structure at a sample rate (Hz)."""
        interval = 1.0 / sample_rate
        poles, shapes = _modes(self.A)
        weight = (self.row @ shapes) * np.linalg.solve(shapes, self.drive[:, :, None])[:, :, 0]
        # One of each conjugate pair, with twice its weight: the real part of the sum is the same.
        weight = weight * (1.0 + np.sign(poles.imag))
        now, after = _hold(poles, interval)
        decay, speed = np.exp(poles * interval), weight * poles
        taken = now + decay * after
        gains = weight * taken, speed * taken
        sums = [np.add.reduce(terms, axis=1).real for terms in (weight * after, weight + speed * after, weight / poles)]
        directs, still = (self.direct + sums[0], sums[1]), self.direct - sums[2]
        return [
            Response(
                poles=poles[i, upper],
                decay=_parts(decay[i, upper]),
                position=Readout(_parts(gains[0][i, upper]), float(directs[0][i])),
                velocity=Readout(_parts(gains[1][i, upper]), float(directs[1][i])),
                interval=interval,
                static_gain=float(still[i]),
                unseen=float(self.unseen[i]),
            )
            for i, upper in enumerate(poles.imag >= 0.0)
        ]


@lru_cache(maxsize=64)
def response(servo: Servo, sample_rate: float) -> Response:
    """The response of a servo's structure at a sample rate (Hz), from its matrices (Eqs 9-13).

    With d = p theta_d and z = x - B_velocity d, z' = A z + (A B_velocity + B_position) d holds no derivative.
    """
    chain = servo.chain()
    row, drive = chain.C_last, servo.p * (chain.A @ chain.B_velocity + chain.B_position)
    direct = servo.p * float(row @ chain.B_velocity + chain.D[-1])
    unseen = float(np.sum(np.sqrt(servo.masses[1:] / servo.stiffnesses[1:])))
    one = Structures(chain.A[None], drive[None], row, np.array([direct]), np.array([unseen]))
    return one.responses(sample_rate)[0]


def _modes(matrices: Array) -> tuple[Complex, Complex]:
    """Eigenvalues (s, N) and eigenvectors (s, N, N) of matrices (s, N, N).

    Where two modes coincide (critical damping) they are split by a relative 1e-9: they have no complete set of
    eigenvectors.
    """
    poles, shapes = (part.astype(complex) for part in np.linalg.eig(matrices))
    # For n columns of length one the condition is below 2 / |determinant|, which takes a fifth of the time.
    uncertain = np.flatnonzero(np.abs(np.linalg.det(shapes)) < 4.0 / _DEFECTIVE)
    for i in uncertain[np.linalg.cond(shapes[uncertain]) > _DEFECTIVE] if uncertain.size else ():
        pattern = np.linspace(-_SPLIT, _SPLIT, matrices[i].size).reshape(matrices[i].shape)
        poles[i], shapes[i] = np.linalg.eig(matrices[i] * (1.0 + pattern))
    return poles, shapes


def _hold(poles: Complex, interval: float) -> tuple[Complex, Complex]:
    """Weights of u[i] and u[i+1] in z[i+1] for z' = pole z + u with u linear in between."""
    x = poles * interval
    small, after = np.abs(x) < _SMALL, np.zeros_like(x)
    if small.any():
        for order in range(_TERMS, 1, -1):
            after = (1.0 + x * after) / order
    if not small.all():
        # exp(x) - 1 - x loses its digits for small x; the 1.0 only avoids a division by zero there.
        far = np.where(small, 1.0, x)
        after = np.where(small, after, (np.exp(far) - 1.0 - far) / far**2)
    return np.asarray(interval * (1.0 + x * after - after)), np.asarray(interval * after)


def _parts(values: Complex) -> Array:
    return np.ascontiguousarray(values).view(float).reshape(-1, 2)


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
