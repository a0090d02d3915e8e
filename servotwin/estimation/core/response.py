"""Exact sampled response of the structure (G2) to the screw's motion, mode by mode.

Between samples the screw's angle is taken as linear (first-order hold), so a step is exact. Each mode runs as a
recurrence of its own, z[i+1] = e z[i] + u[i]: it needs no polynomial, whose coefficients lose their digits when the
sample interval is short, and no product of matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.core.elimination import solve
from servotwin.hybrid.compiled import bare, inlined
from servotwin.plant.linear import Complex
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

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
        return free_motions(self.poles * self.interval, np.ones(self.poles.size, dtype=complex), samples)


def free_motions(exponents: Complex, sizes: Complex, samples: int) -> Array:
    """(2 modes, n) real and imaginary parts of motions size exp(exponent i) of modes, i = 0, 1, ...

    A real exponent gives one row.
    """
    turning = np.abs(exponents.imag) > 0.0
    shares = np.concatenate([sizes, -1j * sizes[turning]])
    out, width = np.zeros((shares.size, samples)), max(1, math.isqrt(samples))
    add_motions(
        np.concatenate([exponents, exponents[turning]])[:, None], shares[:, None], np.empty(width, complex), out
    )
    return out


@bare
def add_motions(exponents: Complex, shares: Complex, near: Complex, out: Array) -> None:
    """Add to rows (r, n) the real parts of share exp(exponent i), i = 0, 1, ..., summed over modes (r, modes).

    Each is a product of two exponentials, of which there are few; `near` (about the root of n,) is room for one kind.
    """
    for row in range(len(out)):
        for mode in range(exponents.shape[1]):
            exponent = exponents[row, mode]
            for i in range(near.size):
                near[i] = np.exp(exponent * i)
            for first in range(0, out.shape[1], near.size):
                far = shares[row, mode] * np.exp(exponent * first)
                for i in range(min(near.size, out.shape[1] - first)):
                    out[row, first + i] += far.real * near[i].real - far.imag * near[i].imag


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
        count, size = poles.shape
        seen = self.row @ shapes
        decay, sums, kept = np.empty((3, count, size, 2)), np.empty((count, 3)), np.empty(count, dtype=np.int64)
        sample_modes(poles, shapes, self.drive.astype(complex), seen, self.direct, interval, decay, sums, kept)
        return [
            Response(
                upper[:modes],
                decay[:modes],
                Readout(position[:modes], direct),
                Readout(velocity[:modes], speed),
                interval,
                still,
                unseen,
            )
            for upper, decay, position, velocity, (direct, speed, still), unseen, modes in zip(
                poles, *decay, sums.tolist(), self.unseen.tolist(), kept.tolist(), strict=True
            )
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


@inlined
def late_share(x: complex) -> complex:
    """(exp(x) - 1 - x) / x^2, by its series where x is so small that this loses its digits."""
    if abs(x) >= _SMALL:
        return (np.exp(x) - 1.0 - x) / (x * x)
    total = 0.0 * x
    for order in range(_TERMS, 1, -1):
        total = (1.0 + x * total) / order
    return total


@bare
def sample_modes(
    poles: Complex,
    shapes: Complex,
    drive: Complex,
    seen: Complex,
    direct: Array,
    interval: float,
    parts: Array,
    sums: Array,
    kept: NDArray[np.int64],
) -> None:
    """Sample the modes of some structures at an interval (s), the input u linear in between: z[i+1] = e z[i] + u[i].

    Parameters
    ----------
    poles, shapes : (s, N), (s, N, N) complex arrays
        Of each conjugate pair one pole is kept, in front; the shapes are used up.
    drive, seen : (s, N) complex arrays
        Of the structure's states, used up; share of each mode in what is read.
    direct : (s,) array
        Of what is read.
    parts : (3, s, N, 2) array
        Decay, gains of position and of velocity of the poles that are kept.
    sums : (s, 3) array
        Direct terms of position and velocity, and the static gain.
    kept : (s,) array
        Poles that are kept.
    """
    for s in range(len(poles)):
        solve(shapes[s], drive[s])
        count, at_once, moving, still = 0, direct[s], 0.0, direct[s]
        for i in range(poles.shape[1]):
            pole = poles[s, i]
            # One of each conjugate pair, with twice its weight: the real part of the sum is the same.
            weight = (1.0 + np.sign(pole.imag)) * (seen[s, i] * drive[s, i])
            x = pole * interval
            share, power = late_share(x), np.exp(x)
            after = interval * share
            taken = interval * (1.0 + x * share - share) + power * after
            at_once += (weight * after).real
            moving += (weight + weight * pole * after).real
            still -= (weight / pole).real
            if pole.imag >= 0.0:
                poles[s, count] = pole
                for k, value in enumerate((power, weight * taken, weight * pole * taken)):
                    parts[k, s, count, 0], parts[k, s, count, 1] = value.real, value.imag
                count += 1
        sums[s, 0], sums[s, 1], sums[s, 2], kept[s] = at_once, moving, still, count


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
