"""Responses of machines that differ from a servo by factors on its structure's numbers, several at once.

The structure's matrices are linear in its stiffnesses, its dampings and the screw's stiffness. They are put together
from their parts, and one call finds the modes of all machines: a tenth of the time of making one servo after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servotwin.estimation.core.response import Response, Structures
from servotwin.hybrid.compiled import bare
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain


class _Parts(NamedTuple):
    """x' = A x + position d + velocity d' as a sum, and the time that a motion takes through the masses.

    Attributes
    ----------
    shares : (4, N, N + 2) array
        [A, position, velocity]: constant part, shares of the stiffnesses, of the dampings, and per N/m of the screw.
    row : (N,) array
    direct : float
    unseen : (float, float)
        Sums of sqrt(m / k): all but the last mass, and the last one.
    """

    shares: Array
    row: Array
    direct: float
    unseen: tuple[float, float]


@lru_cache(maxsize=64)
def _parts(servo: Servo, elastic: bool) -> _Parts:
    """Parts of a servo's structure, with an elastic or a rigid screw."""
    m, k, c = servo.masses, servo.stiffnesses, servo.dampings
    # None of the three, and one at a time.
    only = np.eye(4)[1:, :, None]
    parts = chain(np.tile(m, (4, 1)), only[0] * k, only[1] * c, only[2, :, 0] if elastic else np.inf)
    shares = np.concatenate([parts.A, parts.B_position[:, :, None], parts.B_velocity[:, :, None]], axis=2)
    shares[1:] -= shares[0]
    delays = np.sqrt(m[1:] / k[1:])
    unseen = float(np.sum(delays[:-1])), float(delays[-1])
    return _Parts(shares, parts.C_last, float(parts.D[-1]), unseen)


def variants(
    servo: Servo, factors: Sequence[Array], sample_rate: float, screw: Sequence[float] | None = None
) -> list[Response]:
    """Responses of machines at a sample rate (Hz).

    Parameters
    ----------
    servo : Servo
    factors : sequence of (4,) arrays
        Logarithms of the factors on the stiffnesses, on the dampings, on the pitch, and on the last mass, which with
        two masses has none.
    sample_rate : float
    screw : sequence of float, optional
        N/m, the screw's stiffness in each machine; None: the servo's own.
    """
    elastic, given = screw is not None or not servo.rigid, np.array(factors)
    parts, count = _parts(servo, elastic), len(given)
    stiffness = np.full(count, servo.k_d if elastic else 0.0) if screw is None else np.array(screw)
    size = parts.row.size
    whole, drive, shown = np.empty((count, size, size + 2)), np.empty((count, size)), np.empty((count, 2))
    if servo.n == 2:
        given[:, -1] = 0.0
    assemble(
        np.exp(given), stiffness, servo.p, parts.shares, parts.row, parts.direct, parts.unseen, whole, drive, shown
    )
    return Structures(whole[:, :, :size], drive, parts.row, shown[:, 0], shown[:, 1]).responses(sample_rate)


@bare
def assemble(
    factors: Array,
    screw: Array,
    pitch: float,
    shares: Array,
    row: Array,
    direct: float,
    delays: tuple[float, float],
    whole: Array,
    drive: Array,
    shown: Array,
) -> None:
    """Put structures together: [A, position, velocity] into `whole`, the input's direct term and delay into `shown`.

    Parameters
    ----------
    factors : (s, 4) array
        On stiffnesses, dampings, pitch and last mass.
    screw : (s,) array
        N/m.
    pitch : float
        m/rad, of the servo.
    shares, row, direct, delays
        As of `_Parts`.
    whole : (s, N, N + 2) array
    drive, shown : (s, N), (s, 2) arrays
    """
    size = row.size
    for s in range(len(factors)):
        k, c, heavier, p, A = factors[s, 0], factors[s, 1], factors[s, 3], pitch * factors[s, 2], whole[s]
        for i in range(size):
            for j in range(size + 2):
                A[i, j] = (shares[0, i, j] + k * shares[1, i, j]) + (c * shares[2, i, j] + screw[s] * shares[3, i, j])
        for j in range(size):
            A[size - 1, j] /= heavier
        seen = direct
        for i in range(size):
            total = A[i, size]
            for j in range(size):
                total += A[i, j] * A[j, size + 1]
            drive[s, i] = p * total
            seen += A[i, size + 1] * row[i]
        shown[s, 0], shown[s, 1] = p * seen, (delays[0] + np.sqrt(heavier) * delays[1]) / np.sqrt(k)
