"""Describing function of a dead zone in an elastic shaft, and the limit cycles that it predicts.

The shaft's torque is K dz(phi) + C phi' in contact, phi the angle across backlash and shaft at the motor (Nordin and
Gutman 2002, section 3). The describing function of the dead zone stands for both terms: that of the damper is exact for
C = 0 only, and a flank that would pull lets go earlier than the dead zone does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotwin.control.laws import Law
from servotwin.control.linear_law import LinearLaw
from servotwin.hybrid.automaton import Array
from servotwin.plant.law_loop import law_matrices
from servotwin.plant.linear import Complex
from servotwin.plant.loop import continuous_law
from servotwin.plant.margins import crossings
from servotwin.plant.plants import Plant

_PER_DECADE, _DECADES = 400, 3.0
# Of a frequency, for the slope of a response.
_STEP = 1e-6


@dataclass(frozen=True)
class Prediction:
    """A limit cycle by a describing function: a solution of N(A) L(j omega) = -1.

    Attributes
    ----------
    frequency : float
        Hz.
    motor_amplitude : float
        rad, of the first harmonic of the input of the backlash, A: the motor's angle, or of a free shaft the angle
        across backlash and shaft.
    amplitude : float
        m (rotary: rad), of the first harmonic of the position.
    stable : bool
        True when a larger amplitude would decay and a smaller one grow, by the describing function.
    """

    frequency: float
    motor_amplitude: float
    amplitude: float
    stable: bool


def dead_zone_function(amplitude: float, gap: float) -> float:
    """N(A) of a dead zone of a total width: first harmonic of what is beyond it per that of its input.

    Parameters
    ----------
    amplitude : float
        rad, A.
    gap : float
        rad, TOTAL gap; up to half of it nothing is beyond, and N = 0.
    """
    ratio = 0.5 * gap / amplitude if amplitude > 0.0 else math.inf
    if ratio >= 1.0:
        return 0.0
    return 1.0 - 2.0 / math.pi * (math.asin(ratio) + ratio * math.sqrt(1.0 - ratio * ratio))


@dataclass(frozen=True, eq=False)
class OpenShaft:
    """Motor with its law and load, parted at the shaft: x' = A x + B torque.

    Attributes
    ----------
    A, B : (N, N), (N,) arrays
        B is the column of the shaft's torque at the motor, N m.
    twist, position : (N,) arrays
        Rows of the angle across backlash and shaft (rad at the motor), and of the last mass's position.
    stiffness, damping : float
        Of the shaft, at the motor: N m/rad and N m s/rad.
    """

    A: Array
    B: Array
    twist: Array
    position: Array
    stiffness: float
    damping: float

    @staticmethod
    def of(plant: Plant, law: Law) -> OpenShaft:
        """Part a free shaft in its gap."""
        shaft, chain, p = plant.shaft(), plant.chain(), plant.p
        control = _feedback(plant, law)
        motor, load = len(shaft.names), chain.A.shape[0]
        size = motor + load + control.C.size
        A, B = np.zeros((size, size)), np.zeros(size)
        own, hung, inner = slice(0, motor), slice(motor, motor + load), slice(motor + load, size)
        A[own, own], A[hung, hung], A[inner, inner] = shaft.A, chain.A_open, control.A
        position, twist = np.zeros(size), np.zeros(size)
        position[hung] = chain.C_last
        twist[motor - 1], twist[motor] = 1.0, -1.0 / p
        measured = np.stack([np.eye(size)[motor - 1], position])
        command = control.D @ measured
        command[inner] += control.C
        A[own] += np.outer(shaft.B, command)
        A[inner] += control.B @ measured
        B[own] = -shaft.E
        # A force on the first mass per torque at the motor; B_position is k_d over that mass.
        stiffness = float(chain.reaction_position)
        B[hung] = chain.B_position / stiffness / p
        return OpenShaft(A, B, twist, position, p * p * stiffness, p * p * float(chain.reaction_velocity))

    def response(self, omega: Array) -> Complex:
        """(N, K) first harmonics of the states per that of the torque."""
        s = 1j * np.atleast_1d(omega)
        systems = s[:, None, None] * np.eye(len(self.B)) - self.A
        states = np.linalg.solve(systems, np.broadcast_to(self.B, (s.size, self.B.size))[..., None])[..., 0]
        return np.asarray(states.T, dtype=np.complex128)

    def loop(self, omega: Array) -> Complex:
        """(K,) twist per twist across the closed gap: 1 / N on a limit cycle."""
        return np.asarray((self.stiffness + 1j * omega * self.damping) * (self.twist @ self.response(omega)))


class _Feedback(NamedTuple):
    """x' = A x + B (y_motor, y_load), command = C x + D (y_motor, y_load)."""

    A: Array
    B: Array
    C: Array
    D: Array


def _feedback(plant: Plant, law: Law) -> _Feedback:
    """Command of a continuous law, from the two measurements."""
    if isinstance(law, LinearLaw):
        matrices = law_matrices(law)
        return _Feedback(matrices.A, matrices.B[:, 1:], matrices.C, matrices.D[1:])
    control = continuous_law(law)
    reads = np.array([plant.p, 0.0] if plant.at_motor else [0.0, 1.0])
    return _Feedback(control.A, np.outer(control.B, reads), -control.C, -control.D * reads)


def shaft_predictions(plant: Plant, gap: float, law: Law) -> tuple[Prediction, ...]:
    """All limit cycles that the describing function of the dead zone predicts, by frequency."""
    parted = OpenShaft.of(plant, law)
    sizes = np.abs(np.linalg.eigvals(parted.A))
    sizes = np.append(
        sizes[sizes > 1e-9 * sizes.max()], math.sqrt(parted.stiffness * abs(parted.twist @ parted.B)) or 1.0
    )
    edge = 10.0**_DECADES
    low, high = float(sizes.min()) / edge, float(sizes.max()) * edge
    grid = np.geomspace(low, high, int(_PER_DECADE * math.log10(high / low)))
    found = crossings(lambda omega: parted.loop(np.asarray(omega)).imag, grid)
    every = [_prediction(parted, gap, omega) for omega in found]
    return tuple(one for one in every if one is not None)


def _prediction(parted: OpenShaft, gap: float, omega: float) -> Prediction | None:
    """The limit cycle of a frequency at which the loop is real; None: the whole shaft is too soft for one."""
    value = complex(parted.loop(np.array([omega]))[0])
    if not value.real > 1.0:
        return None
    amplitude = _amplitude(1.0 / value.real, gap)
    states = parted.response(np.array([omega]))[:, 0]
    position = amplitude * abs((parted.position @ states) / (parted.twist @ states))
    beside = parted.loop(omega * np.array([1.0 - _STEP, 1.0 + _STEP]))
    slope = (beside[1] - beside[0]) / (2j * omega * _STEP)
    # N grows with A: a larger amplitude moves s by - (N_A / N) (H / H') dA.
    return Prediction(omega / (2.0 * math.pi), amplitude, float(position), bool((value / slope).real > 0.0))


def _amplitude(part: float, gap: float) -> float:
    """The amplitude at which N is a part of one, rad."""
    from scipy.optimize import brentq

    def missing(ratio: float) -> float:
        return dead_zone_function(1.0, 2.0 * ratio) - part

    return 0.5 * gap / float(brentq(missing, 0.0, 1.0, xtol=1e-15))
