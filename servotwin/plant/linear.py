"""Linear single-input single-output systems, held twice: as state space for time, as polynomials for frequency.

Both forms are built side by side from physical parameters, so neither suffers from a conversion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput
from servotwin.plant.motor import ANGLE, SPEED, motor_transfer
from servotwin.plant.polynomials import minus, plus, times
from servotwin.plant.signals import Array
from servotwin.plant.structure import Chain, transfer

if TYPE_CHECKING:
    from servotwin.control.controller import Controller
    from servotwin.plant.servo import Servo

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """y = G(s) u, G = numerator / denominator = C (s - A)^-1 B + D.

    Attributes
    ----------
    A, B, C, D : (N, N), (N,), (N,) arrays and float
    numerator, denominator : arrays
        Coefficients in ascending powers of s; common factors are not cancelled.
    """

    A: Array
    B: Array
    C: Array
    D: float
    numerator: Array
    denominator: Array

    def response(self, omega: ArrayLike) -> Complex:
        """G(j omega) for omega in rad/s."""
        s = 1j * np.asarray(omega, dtype=float)
        return np.asarray(poly.polyval(s, self.numerator) / poly.polyval(s, self.denominator))

    def poles(self) -> Complex:
        """(N,) eigenvalues of A, 1/s."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=complex)

    def is_stable(self) -> bool:
        """Whether every pole lies left of the imaginary axis."""
        return self.A.size == 0 or bool(np.max(self.poles().real) < 0.0)

    def step(self, time: ArrayLike) -> Array:
        """(n,) response at equally spaced times (s, from 0) to a unit step, exact by a matrix exponential (Fig 5a)."""
        time = np.asarray(time, dtype=float)
        advance, drive = held(self.A, self.B, float(time[1] - time[0]))
        states = np.zeros((time.size, self.B.size))
        for i in range(1, time.size):
            states[i] = advance @ states[i - 1] + drive
        return np.asarray(states @ self.C + self.D)

    def to_control(self) -> Any:
        """The same system as a python-control StateSpace.

        Raises
        ------
        InvalidInput
            python-control is not installed.
        """
        try:
            import control
        except ImportError:
            raise InvalidInput("python-control is not installed; give: pip install 'servotwin[interop]'") from None
        return control.ss(self.A, self.B[:, None], self.C[None, :], [[self.D]])


def held(A: Array, B: Array, step: float) -> tuple[Array, Array]:
    """(A_d, B_d) of x' = A x + B u over `step` seconds of constant u (zero-order hold), by a matrix exponential."""
    from scipy.linalg import expm

    size = B.size
    flow = np.zeros((size + 1, size + 1))
    flow[:size, :size], flow[:size, size] = A, B
    advance = expm(flow * step)
    return advance[:size, :size], advance[:size, size]


def gain(value: float) -> LinearSystem:
    """A constant."""
    return LinearSystem(np.zeros((0, 0)), np.zeros(0), np.zeros(0), value, np.array([value]), np.array([1.0]))


def lag(value: float, time: float) -> LinearSystem:
    """value / (time s + 1)."""
    A, B, C = np.array([[-1.0 / time]]), np.array([1.0 / time]), np.array([value])
    return LinearSystem(A, B, C, 0.0, np.array([value]), np.array([1.0, time]))


def integrator(value: float) -> LinearSystem:
    """value / s."""
    return LinearSystem(
        np.zeros((1, 1)), np.array([value]), np.array([1.0]), 0.0, np.array([value]), np.array([0.0, 1.0])
    )


def series(first: LinearSystem, second: LinearSystem) -> LinearSystem:
    """second(first(u))."""
    n, m = first.B.size, second.B.size
    A = np.block([[first.A, np.zeros((n, m))], [np.outer(second.B, first.C), second.A]])
    B = np.concatenate([first.B, second.B * first.D])
    C = np.concatenate([second.D * first.C, second.C])
    numerator = times(first.numerator, second.numerator)
    denominator = times(first.denominator, second.denominator)
    return LinearSystem(A, B, C, second.D * first.D, numerator, denominator)


def parallel(first: LinearSystem, second: LinearSystem) -> LinearSystem:
    """first(u) + second(u)."""
    n, m = first.B.size, second.B.size
    A = np.block([[first.A, np.zeros((n, m))], [np.zeros((m, n)), second.A]])
    numerator = plus(times(first.numerator, second.denominator), times(second.numerator, first.denominator))
    return LinearSystem(
        A,
        np.concatenate([first.B, second.B]),
        np.concatenate([first.C, second.C]),
        first.D + second.D,
        numerator,
        times(first.denominator, second.denominator),
    )


def feedback(forward: LinearSystem, back: LinearSystem) -> LinearSystem:
    """forward / (1 + forward back), for a loop without a direct path (forward.D = 0)."""
    if forward.D != 0.0:
        raise InvalidInput("feedback: the forward path must be strictly proper")
    n, m = forward.B.size, back.B.size
    A = np.block([[forward.A, np.zeros((n, m))], [np.zeros((m, n)), back.A]])
    B = np.concatenate([forward.B, np.zeros(m)])
    C = np.concatenate([forward.C, np.zeros(m)])
    A[:n] -= np.outer(forward.B, np.concatenate([back.D * forward.C, back.C]))
    A[n:] += np.outer(back.B, C)
    denominator = plus(times(forward.denominator, back.denominator), times(forward.numerator, back.numerator))
    return LinearSystem(A, B, C, 0.0, times(forward.numerator, back.denominator), denominator)


def motor(servo: Servo) -> LinearSystem:
    """G1, voltage to the unloaded motor's angle (Eq 8)."""
    A, B, _ = servo.motor()
    numbers = (servo.J, servo.L, servo.R, servo.k_T, servo.k_B)
    return LinearSystem(A, B, np.eye(3)[ANGLE], 0.0, *motor_transfer(*numbers))


def structure(servo: Servo) -> LinearSystem:
    """G2, angle of the screw to the position of the last mass (Eq 13 for n = 3).

    The input's derivative is absorbed by the state: z = x - B_velocity d.
    """
    links = servo.chain()
    B = servo.p * (links.B_position + links.A @ links.B_velocity)
    numerator, denominator, _ = transfer(servo.masses, servo.stiffnesses, servo.dampings, servo.k_d)
    return LinearSystem(links.A, B, links.C_last, 0.0, servo.p * numerator, denominator)


def plant(servo: Servo) -> LinearSystem:
    """Voltage to the position of the last mass without a gap: G1 G2; with finite k_d the load acts on the motor."""
    if servo.rigid:
        return series(motor(servo), structure(servo))
    return _loaded(servo, servo.chain())


def _loaded(servo: Servo, links: Chain) -> LinearSystem:
    """Motor and chain coupled: the screw's force F turns the motor back with the torque p F."""
    A_m, B_m, E = servo.motor()
    size = links.B_position.size
    A = np.zeros((3 + size, 3 + size))
    A[:3, :3], A[3:, 3:] = A_m, links.A
    A[3:, ANGLE] = servo.p * links.B_position
    A[SPEED, 3:] = -servo.p * E[SPEED] * links.reaction
    A[SPEED, ANGLE] = -servo.p * E[SPEED] * links.reaction_position * servo.p
    B = np.concatenate([B_m, np.zeros(size)])
    C = np.concatenate([np.zeros(3), links.C_last])
    return LinearSystem(A, B, C, 0.0, *_loaded_transfer(servo))


def _loaded_transfer(servo: Servo) -> tuple[Array, Array]:
    """(L s + R)(J s^2 theta + p F) = k_T (u - k_B s theta), F = k_d p theta (1 - k_d inner / whole)."""
    numerator, whole, inner = transfer(servo.masses, servo.stiffnesses, servo.dampings, servo.k_d)
    electric = np.array([servo.R, servo.L])
    reaction = servo.p**2 * servo.k_d * minus(whole, servo.k_d * inner)
    mechanical = plus(times(np.array([0.0, 0.0, servo.J]), whole), reaction)
    back_emf = times(np.array([0.0, servo.k_T * servo.k_B]), whole)
    return servo.k_T * servo.p * numerator, plus(times(electric, mechanical), back_emf)


def pidf(controller: Controller) -> LinearSystem:
    """C_PIDF = Kp + Ki/s + Kd s/(Tf s + 1) (Eq 14); terms whose gain is zero have no state."""
    system = gain(controller.Kp)
    if controller.Ki != 0.0:
        system = parallel(system, integrator(controller.Ki))
    if controller.Kd != 0.0:
        rate = controller.Kd / controller.Tf
        system = parallel(system, parallel(gain(rate), lag(-rate, controller.Tf)))
    return system


def loop_filter(controller: Controller) -> LinearSystem:
    """The first-order low-pass on the measurement (section 4.3), or 1 where there is none."""
    if controller.loop_filter_hz is None:
        return gain(1.0)
    return lag(1.0, 1.0 / (2.0 * math.pi * controller.loop_filter_hz))
