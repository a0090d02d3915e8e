"""The play operator with its exact sensitivities: what each contact says about the gap.

The screw's angle is piecewise affine in the gap and in where the screw began. Pushed forwards it is theta_m - half the
gap, pushed backwards theta_m + half the gap, and it keeps what the last contact gave it. Before the first contact it
rests where it began.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.hybrid.compiled import bare
from servotwin.plant.signals import Array

SCREW, BY_GAP, BY_START, BY_RATE = range(4)


class Gap(NamedTuple):
    """A gap that is linear in time, and where the screw began.

    Attributes
    ----------
    gap : float
        rad, TOTAL gap in the middle of the window.
    theta_d0 : float
        rad, the screw's angle before the first sample; clamped into the gap there.
    rate : float
        rad per sample.
    """

    gap: float
    theta_d0: float
    rate: float = 0.0


class Travel(NamedTuple):
    """How far (rad) the motor pushed the screw forwards and backwards, and the range of its lead over the screw."""

    forwards: float
    backwards: float
    lead: float


def contacts(theta_m: Array, at: Gap) -> Array:
    """(4, n) the screw's angle (rad) and its derivatives by gap, theta_d0 and rate, for the motor's angle (n,).

    Where a contact begins, the derivatives are those of the side that the screw is on: the first sample in contact
    belongs to the contact.
    """
    out = np.empty((4, theta_m.size))
    follow(theta_m, at.gap, at.theta_d0, at.rate, out)
    return out


@bare
def follow(theta_m: Array, gap: float, theta_d0: float, rate: float, out: Array) -> None:
    """`contacts` into `out` (4, n)."""
    screw, by_gap, by_start, by_rate = theta_d0, 0.0, 1.0, 0.0
    middle = 0.5 * (theta_m.size - 1)
    for i in range(theta_m.size):
        half = 0.5 * (gap + rate * (i - middle))
        pushed, held = theta_m[i] - half, theta_m[i] + half
        if pushed > screw:
            screw, by_gap, by_start, by_rate = pushed, -0.5, 0.0, -0.5 * (i - middle)
        elif held < screw:
            screw, by_gap, by_start, by_rate = held, 0.5, 0.0, 0.5 * (i - middle)
        out[0, i], out[1, i], out[2, i], out[3, i] = screw, by_gap, by_start, by_rate


@bare
def follow_screw(theta_m: Array, gap: float, theta_d0: float, rate: float, out: Array) -> None:
    """The screw's angle alone, into `out` (n,)."""
    screw = theta_d0
    middle = 0.5 * (theta_m.size - 1)
    for i in range(theta_m.size):
        half = 0.5 * (gap + rate * (i - middle))
        screw = min(max(screw, theta_m[i] - half), theta_m[i] + half)
        out[i] = screw


def travel(theta_m: Array, at: Gap) -> Travel:
    """What the contacts did to the screw in a window, for the motor's angle (n,)."""
    screw = np.empty(theta_m.size)
    follow_screw(theta_m, *at, screw)
    moved = np.diff(screw)
    lead = float(np.ptp(theta_m - screw))
    return Travel(float(moved[moved > 0.0].sum()), float(-moved[moved < 0.0].sum()), lead)
