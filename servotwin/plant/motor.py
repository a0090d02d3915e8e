"""The DC motor (Eqs 1-8): L I' + R I = u - k_B omega, J omega' = k_T I + torque, theta_m' = omega."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.plant.signals import Array

CURRENT, SPEED, ANGLE = 0, 1, 2


class Motor(NamedTuple):
    """Parameters of the motor: kg m^2, H, ohm, N m/A, V s/rad."""

    J: float
    L: float
    R: float
    k_T: float
    k_B: float

    def matrices(self) -> tuple[Array, Array, Array]:
        """Matrices of x = (I, omega, theta_m), x' = A x + B u + E torque.

        Returns
        -------
        A : (3, 3) array
        B : (3,) array
            Column of the input voltage u, V.
        E : (3,) array
            Column of an external torque on the shaft, N m (positive accelerates).
        """
        A = np.array([[-self.R / self.L, -self.k_B / self.L, 0.0], [self.k_T / self.J, 0.0, 0.0], [0.0, 1.0, 0.0]])
        return A, np.array([1.0 / self.L, 0.0, 0.0]), np.array([0.0, 1.0 / self.J, 0.0])

    def transfer(self) -> tuple[Array, Array]:
        """G1 = theta_m / u (Eq 8) as (numerator, denominator), ascending powers of s."""
        return np.array([self.k_T]), np.array([0.0, self.k_B * self.k_T, self.J * self.R, self.J * self.L])
