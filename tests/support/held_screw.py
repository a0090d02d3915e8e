"""A motor before an elastic screw that the gap holds, with its loop on the motor's encoder, once more in small steps.

It shares nothing with servotwin's simulation: fixed steps, first order.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass
class HeldScrew:
    """Torque drive with viscous friction, gap, spring, one free mass, and a sampled PIDF on the motor's encoder.

    Attributes
    ----------
    J, lag, friction : float
        Inertia, kg m^2; time constant of the current loop, s; N m s/rad.
    p, k, m, c : float
        m/rad, N/m, kg, N s/m.
    gains : (float, float, float, float)
        Kp, Ki, Kd, Tf of the loop, per m.
    count, rate, gap : float
        rad, Hz, rad.
    damping : float
        N s/m, beside the spring.
    """

    J: float
    lag: float
    friction: float
    p: float
    k: float
    m: float
    c: float
    gains: tuple[float, float, float, float]
    count: float
    rate: float
    gap: float
    damping: float = 0.0

    def run(self, reference: Array, parts: int) -> tuple[Array, Array, Array]:
        """Measured angle (rad), command (N m) and load (m) at the samples of a reference (m), `parts` steps each."""
        step, half = 1.0 / (self.rate * parts), 0.5 * self.gap
        kp, ki, kd, tf = self.gains
        fade = math.exp(-1.0 / (self.rate * tf))
        torque = speed = angle = screw = place = velocity = total = filtered = 0.0
        side, begun, table = 0, False, np.empty((3, reference.size))
        for i, wanted in enumerate(reference.tolist()):
            seen = self.count * round(angle / self.count)
            error = wanted - self.p * seen
            filtered = filtered if begun else 0.0
            begun = True
            command = kp * error + total + kd / tf * (error - filtered)
            table[:, i] = seen, command, place
            total += ki * error / self.rate
            filtered = fade * filtered + (1.0 - fade) * error
            for _ in range(parts):
                # The screw moves with the motor on its flank, and not at all in the gap.
                force = self.k * (self.p * screw - place) + self.damping * (self.p * speed * abs(side) - velocity)
                torque += step * (command - torque) / self.lag
                free = torque - self.friction * speed
                push = free - self.p * force
                if side == 0:
                    speed += step * free / self.J
                elif side * speed > 0.0 or side * push > 0.0:
                    speed += step * push / self.J
                    if side * speed <= 0.0:
                        speed = 0.0
                elif side * free < 0.0:
                    side, speed = 0, step * free / self.J
                else:
                    speed = 0.0
                angle += step * speed
                velocity += step * (force - self.c * velocity) / self.m
                place += step * velocity
                if side:
                    screw = angle - side * half
                elif abs(angle - screw) >= half:
                    side = 1 if angle > screw else -1
                    screw = angle - side * half
        return table[0], table[1], table[2]
