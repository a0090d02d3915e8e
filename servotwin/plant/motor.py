"""The DC motor (Eqs 1-8): L I' + R I = u - k_B omega, J omega' = k_T I + torque, theta_m' = omega."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from servotwin.plant.actuator import ShaftMatrices
from servotwin.plant.signals import Array

CURRENT, SPEED, ANGLE = 0, 1, 2


class Motor(NamedTuple):
    """Parameters of the motor, or of many as arrays: kg m^2, H, ohm, N m/A, V s/rad."""

    J: Any
    L: Any
    R: Any
    k_T: Any
    k_B: Any

    def matrices(self) -> tuple[Array, Array, Array]:
        """Matrices of x = (I, omega, theta_m), x' = A x + B u + E torque; many motors' on leading axes.

        Returns
        -------
        A : (3, 3) array
        B : (3,) array
            Column of the input voltage u, V.
        E : (3,) array
            Column of an external torque on the shaft, N m (positive accelerates).
        """
        lead = np.shape(self.J)
        A, (B, E) = np.zeros((*lead, 3, 3)), np.zeros((2, *lead, 3))
        A[..., 0, 0], A[..., 0, 1], A[..., 1, 0] = -self.R / self.L, -self.k_B / self.L, self.k_T / self.J
        A[..., 2, 1] = 1.0
        B[..., 0], E[..., 1] = 1.0 / self.L, 1.0 / self.J
        return A, B, E

    def shaft(self) -> ShaftMatrices:
        """The same by name, with the row of the torque."""
        A, B, E = self.matrices()
        torque = np.zeros_like(B)
        torque[..., CURRENT] = self.k_T
        yielding = self.R / (self.k_T * self.k_B)
        column = yielding if np.ndim(yielding) == 0 else np.asarray(yielding)[:, None]
        return ShaftMatrices(("current", "speed", "theta_m"), A, B, E, torque, 0.0, column)

    def transfer(self) -> tuple[Array, Array]:
        """G1 = theta_m / u (Eq 8) as (numerator, denominator), ascending powers of s."""
        return np.array([self.k_T]), np.array([0.0, self.k_B * self.k_T, self.J * self.R, self.J * self.L])
