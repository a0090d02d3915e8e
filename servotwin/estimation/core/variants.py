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
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain


class _Parts(NamedTuple):
    """x' = A x + position d + velocity d': shares of the stiffnesses, of the dampings, and per N/m of the screw."""

    upper: Array
    A_by_k: Array
    A_by_c: Array
    A_by_screw: Array
    position_by_k: Array
    position_by_screw: Array
    velocity: Array
    row: Array
    direct: float
    masses: Array
    stiffnesses: Array


@lru_cache(maxsize=64)
def _parts(servo: Servo, elastic: bool) -> _Parts:
    """Parts of a servo's structure, with an elastic or a rigid screw."""
    m, k, c = servo.masses, servo.stiffnesses, servo.dampings
    screw = 1.0 if elastic else np.inf
    none = chain(m, 0.0 * k, 0.0 * c, 0.0 if elastic else np.inf)
    stiff, damped = (chain(m, *one, 0.0 if elastic else np.inf) for one in ((k, 0.0 * c), (0.0 * k, c)))
    soft = chain(m, 0.0 * k, 0.0 * c, screw)
    return _Parts(
        none.A,
        stiff.A - none.A,
        damped.A - none.A,
        soft.A - none.A,
        stiff.B_position - none.B_position,
        soft.B_position - none.B_position,
        damped.B_velocity,
        none.C_last,
        float(none.D[-1]),
        m,
        k,
    )


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
    k, c, pitch, last = np.exp(np.array(factors)).T
    p, elastic = pitch * servo.p, screw is not None or not servo.rigid
    parts = _parts(servo, elastic)
    A = parts.upper + _times(k, parts.A_by_k) + _times(c, parts.A_by_c)
    position, velocity = _times(k, parts.position_by_k), _times(c, parts.velocity)
    if elastic:
        stiffness = np.full(k.size, servo.k_d) if screw is None else np.array(screw)
        A += _times(stiffness, parts.A_by_screw)
        position += _times(stiffness, parts.position_by_screw)
    masses = _times(np.ones(k.size), parts.masses)
    if servo.n > 2:
        A[:, -1] /= last[:, None]
        masses[:, -1] *= last
    drive = p[:, None] * ((A @ velocity[:, :, None])[:, :, 0] + position)
    unseen = np.sqrt(masses[:, 1:] / _times(k, parts.stiffnesses[1:])).sum(axis=1)
    return Structures(A, drive, parts.row, p * (velocity @ parts.row + parts.direct), unseen).responses(sample_rate)


def _times(factors: Array, part: Array) -> Array:
    """(s, ...) a part times each factor (s,)."""
    return factors.reshape(-1, *part.ndim * [1]) * part
