"""The loop's equations as matrices, the way one writes them down for another solver (Eqs 1-14, 20)."""

from __future__ import annotations

from dataclasses import dataclass

from servotwin.hybrid.automaton import Array
from servotwin.plant.servo import Servo


@dataclass(frozen=True, eq=False)
class Model:
    """Motor, chain and filtered PID; the gap and the dead zone between them are the solver's business.

    Attributes
    ----------
    motor_A, motor_B : (3, 3) and (3,) arrays
        Of (current, speed, angle) and the voltage.
    chain_A, chain_B : (4, 4) and (4,) arrays
        Of the chain's states and the screw's angle; the rate of the screw is substituted away.
    position : (4,) array
        Row of the last mass.
    Kp, Ki, N, Tf : float
        N = Kd / Tf; the voltage is Kp e + Ki (integral of e) + N (e - lagged e).
    """

    motor_A: Array
    motor_B: Array
    chain_A: Array
    chain_B: Array
    position: Array
    Kp: float
    Ki: float
    N: float
    Tf: float


def model_of(servo: Servo) -> Model:
    """The model of a servo with three masses, a rigid screw and its own continuous controller."""
    A, B, _ = servo.motor()
    chain, law = servo.chain(), servo.controller
    # x' = A x + B_p d + B_v d' becomes z' = A z + (B_p + A B_v) d with z = x - B_v d; positions are not touched.
    drive = servo.p * (chain.B_position + chain.A @ chain.B_velocity)
    return Model(A, B, chain.A, drive, chain.C_last, law.Kp, law.Ki, law.Kd / law.Tf, law.Tf)
