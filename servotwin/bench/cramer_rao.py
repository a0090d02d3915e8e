"""The Cramer-Rao bound of the gap, by code of its own: nothing here is the estimator's.

The structure runs through scipy's lsim, the play operator is differenced numerically, the noise is whitened by the
Cholesky factor of its covariance.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy.linalg import cholesky, expm, solve_triangular, toeplitz
from scipy.signal import lsim, sosfreqz

from servotwin.plant.backlash import play
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_STEP = 1e-7  # rad


@lru_cache(maxsize=8)
def noise_root(samples: int, rate: float, floor: float, noise: Noise | None) -> Array:
    """(n, n) lower Cholesky factor of the covariance of white noise of `floor` (m) and, independent of it, `noise`.

    White noise alone has its standard deviation as factor, (1, 1).
    """
    if noise is None:
        return np.array([[floor]])
    _, gain = sosfreqz(noise.filter(rate), worN=1 << 17, whole=True)
    covariance = noise.std**2 * np.fft.ifft(np.abs(gain) ** 2).real[:samples]
    covariance[0] += floor**2
    return np.asarray(cholesky(toeplitz(covariance), lower=True))


def bound(servo: Servo, theta_m: Array, rate: float, gap: float, theta_d0: float, root: Array) -> float:
    """Smallest standard deviation (rad) of an unbiased estimate of the gap.

    Unknown beside it: the screw's start, the structure's initial state, the encoder's offset, the channels' delay.

    Parameters
    ----------
    servo : Servo
    theta_m : (n,) array
        rad.
    rate : float
        Hz.
    gap, theta_d0 : float
        rad, the truth.
    root : (n, n) or (1, 1) array
        Of the noise: `noise_root`.
    """
    times = np.arange(theta_m.size) / rate
    first = theta_m[0]

    def position(gap: float, theta_d0: float) -> Array:
        return _respond(servo, play(theta_m - first, gap, theta_d0 - first), times)

    here = position(gap, theta_d0)
    inwards = math.copysign(_STEP, first - theta_d0)
    by_gap = (position(gap + _STEP, theta_d0) - here) / _STEP
    by_start = (position(gap, theta_d0 + inwards) - here) / inwards
    others = np.vstack([by_start, np.gradient(here, times), np.ones_like(here), _free(servo, rate, here.size)])
    return _spread(by_gap, others, root)


def _spread(column: Array, others: Array, root: Array) -> float:
    others = others[np.abs(others).max(axis=1) > 0.0]
    table = np.vstack([others / np.linalg.norm(others, axis=1)[:, None], column])
    white = table.T / root[0, 0] if root.size == 1 else solve_triangular(root, table.T, lower=True)
    triangle = np.asarray(np.linalg.qr(white, mode="r"))
    return float(1.0 / abs(triangle[-1, -1]))


def _respond(servo: Servo, theta_d: Array, times: Array) -> Array:
    """(n,) position of the last mass for samples of theta_d (rad), linear in between, from rest."""
    chain = servo.chain()
    velocity = chain.B_velocity
    drive = servo.p * (chain.A @ velocity + chain.B_position)
    direct = servo.p * (chain.C_last @ velocity + chain.D[-1])
    return np.asarray(lsim((chain.A, drive[:, None], chain.C[-1:], [[direct]]), theta_d, times)[1])


def _free(servo: Servo, rate: float, samples: int) -> Array:
    """(N, n) free motions of the last mass, one for every state."""
    chain = servo.chain()
    step, row, rows = expm(chain.A / rate), chain.C_last, []
    for _ in range(samples):
        rows.append(row)
        row = row @ step
    return np.array(rows).T
