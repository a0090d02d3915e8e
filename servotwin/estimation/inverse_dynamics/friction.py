"""Friction of a drive at the speeds of its log: known better than its viscous and Coulomb parts, which trade off."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from servotwin.estimation.inverse_dynamics.fit import SYMMETRIC, ParameterFit
from servotwin.plant.signals import Array

_PARTS = [SYMMETRIC.index("viscous"), SYMMETRIC.index("coulomb")]


@dataclass(frozen=True)
class FrictionForce:
    """Friction at a constant speed, the mean of both directions.

    Attributes
    ----------
    speed : float
        m/s; rotary: rad/s.
    force, half_width : float
        N (rotary: N m; the command's unit where its scale is not known), and half of the 95 % interval.
    """

    speed: float
    force: float
    half_width: float


def friction_forces(fit: ParameterFit, speeds: Array, beside: Array) -> tuple[FrictionForce, ...]:
    """Friction of a symmetric fit at (s,) speeds; `beside` (s,) are differences that other effects may make to it."""
    covariance = fit.covariance[np.ix_(_PARTS, _PARTS)]
    quantile = float(stdtrit(max(float(fit.freedom[_PARTS].min()), 1.0), 0.975))
    found = []
    for speed, off in zip(speeds.tolist(), beside.tolist(), strict=True):
        parts = np.array([speed, 1.0])
        std = math.hypot(math.sqrt(float(parts @ covariance @ parts)), off)
        found.append(FrictionForce(speed, float(parts @ fit.values[_PARTS]), quantile * std))
    return tuple(found)
