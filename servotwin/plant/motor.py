"""The DC motor (Eqs 1-8): L I' + R I = u - k_B omega, J omega' = k_T I + torque, theta_m' = omega."""

from __future__ import annotations

import numpy as np

from servotwin.plant.signals import Array

CURRENT, SPEED, ANGLE = 0, 1, 2


def motor_matrices(J: float, L: float, R: float, k_T: float, k_B: float) -> tuple[Array, Array, Array]:
    """Matrices of x = (I, omega, theta_m), x' = A x + B u + E torque.

    Returns
    -------
    A : (3, 3) array
    B : (3,) array
        Column of the input voltage u, V.
    E : (3,) array
        Column of an external torque on the shaft, N m (positive accelerates).
    """
    A = np.array([[-R / L, -k_B / L, 0.0], [k_T / J, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return A, np.array([1.0 / L, 0.0, 0.0]), np.array([0.0, 1.0 / J, 0.0])


def motor_transfer(J: float, L: float, R: float, k_T: float, k_B: float) -> tuple[Array, Array]:
    """G1 = theta_m / u (Eq 8) as (numerator, denominator), ascending powers of s."""
    return np.array([k_T]), np.array([0.0, k_B * k_T, J * R, J * L])
