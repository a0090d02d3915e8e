"""The Cramer-Rao bound of the gap, by code independent of the estimator.

The structure runs through scipy's lsim, the play operator is differenced numerically, the noise is whitened by the
Cholesky factor of its covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

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


def bound(
    servo: Servo,
    theta_m: Array,
    rate: float,
    gap: float,
    theta_d0: float,
    root: Array,
    free: Sequence[str] = (),
    angles: Array | None = None,
) -> float:
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
    free : sequence of str
        Of "k", "c", "p": unknown too.
    angles : (a, n) array, optional
        Derivatives of theta_m by what it depends on where it is not measured: `motor_unknowns`.
    """
    times = np.arange(theta_m.size) / rate
    first = theta_m[0]

    def position(gap: float, theta_d0: float, model: Servo = servo, angle: Array = theta_m) -> Array:
        return _respond(model, play(angle - first, gap, theta_d0 - first), times)

    here = position(gap, theta_d0)
    inwards = math.copysign(_STEP, first - theta_d0)
    by_gap = (position(gap + _STEP, theta_d0) - here) / _STEP
    by_start = (position(gap, theta_d0 + inwards) - here) / inwards
    by_model = [(position(gap, theta_d0, _scaled(servo, name)) - here) / _STEP for name in free]
    by_angle = []
    for row in () if angles is None else angles:
        step = _STEP / np.abs(row).max()
        by_angle.append((position(gap, theta_d0, angle=theta_m + step * row) - here) / step)
    usual = [by_start, np.gradient(here, times), np.ones_like(here), _free(servo, rate, here.size)]
    others = np.vstack([*usual, *by_model, *by_angle])
    return _spread(by_gap, others, root)


def motor_unknowns(servo: Servo, voltage: Array, rate: float, zero_order_hold: bool) -> Array:
    """(3, n) derivatives of theta_m (rad) by the logarithm of k_B, the current (A) and the speed (rad/s) at first.

    Parameters
    ----------
    servo : Servo
    voltage : (n,) array
        V.
    rate : float
        Hz.
    zero_order_hold : bool
        True where the voltage is constant between samples; False: linear.
    """
    times = np.arange(voltage.size) / rate

    def angle(model: Servo, start: Sequence[float], drive: Array) -> Array:
        electric, mechanic = [-model.R / model.L, -model.k_B / model.L, 0.0], [model.k_T / model.J, 0.0, 0.0]
        system = ([electric, mechanic, [0.0, 1.0, 0.0]], [[1.0 / model.L], [0.0], [0.0]], [[0.0, 0.0, 1.0]], [[0.0]])
        return np.asarray(lsim(system, drive, times, X0=start, interp=not zero_order_hold)[1])

    speed = float(voltage[0]) / servo.k_B
    here, step = angle(servo, (0.0, speed, 0.0), voltage), 1e-4
    other = angle(servo.replace(k_B=(1.0 + step) * servo.k_B), (0.0, speed, 0.0), voltage)
    by_state = [angle(servo, start, 0.0 * voltage) for start in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))]
    return np.vstack([(other - here) / step, *by_state])


def _scaled(servo: Servo, name: str) -> Servo:
    """Increase one number of the servo by the step."""
    value = getattr(servo, name)
    larger = tuple((1.0 + _STEP) * one for one in value) if isinstance(value, tuple) else (1.0 + _STEP) * value
    changes: dict[str, Any] = {name: larger}
    return servo.replace(**changes)


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
