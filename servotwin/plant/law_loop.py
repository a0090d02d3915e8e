"""The loop of a linear law without a gap, cut at the command: response, poles, margins; continuous or sampled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_tick import LinearState, linear_tick
from servotwin.errors import InvalidInput
from servotwin.plant.late_readings import late_readings
from servotwin.plant.linear import Complex, LinearSystem, zero_order_hold
from servotwin.plant.margins import Margins, margins_of_response, search_frequencies
from servotwin.plant.signals import Array

_INPUTS = np.eye(3)
_NO_POLYNOMIAL = np.array([math.nan])
_ZERO_AT_INFINITY = 1e12
# A pole this much smaller than the largest is an integrator's, as rounding splits a double one.
_INTEGRATOR = 1e-7


class LawMatrices(NamedTuple):
    """x' = A x + B (r, y_motor, y_load), command = C x + D (r, y_motor, y_load); of a sampled law x' is the next x."""

    A: Array
    B: Array
    C: Array
    D: Array


def ticked_law(law: LinearLaw) -> LawMatrices:
    """One tick of a law as matrices, its limits and dead zone off: the edge's own tick applied to unit states.

    Raises
    ------
    InvalidInput
        The law is continuous.
    """
    parameters = law.replace(voltage_limit=None, rate_limit=None, feedforward=0.0).parameters()
    size = len(parameters.output) // 2 - len(_INPUTS)
    still = LinearState((0.0,) * size, 0.0, 1.0, 0.0)
    starts = [still._replace(states=tuple(row)) for row in np.eye(size).tolist()]
    ticks = [linear_tick(parameters, start, 0.0, 0.0, 0.0) for start in starts]
    ticks += [linear_tick(parameters, still, *row) for row in _INPUTS.tolist()]
    moved = np.array([after.states for after in ticks]).T[: law.n]
    command = np.array([after.command for after in ticks])
    return LawMatrices(moved[:, : law.n], moved[:, size:], command[: law.n], command[size:])


def law_matrices(law: LinearLaw) -> LawMatrices:
    """Matrices of a law as they are given, as arrays."""
    n = law.n
    return LawMatrices(
        np.array(law.A).reshape(n, n), np.array(law.B).reshape(n, len(_INPUTS)), np.array(law.C), np.array(law.D)
    )


def law_response(law: LinearLaw, omega: float) -> Complex:
    """(3,) response of the command to reference, y_motor and y_load at one frequency, rad/s."""
    if law.sample_rate is None:
        matrices, point = law_matrices(law), 1j * omega
    else:
        matrices, point = ticked_law(law), np.exp(1j * omega / law.sample_rate)
    A, B, C, D = matrices
    return np.asarray(C @ np.linalg.solve(point * np.eye(len(A)) - A, B.astype(complex)) + D)


class _ReadPlant(NamedTuple):
    """x' = A x + B command, readings (y_motor, y_load) = readings x; in sampled time x' is the next x."""

    A: Array
    B: Array
    readings: Array


@dataclass(frozen=True, eq=False)
class LawLoop:
    """A linear law on a plant without a gap.

    Attributes
    ----------
    motor, load : LinearSystem
        Command to the motor's angle (rad) and to the load's position (m or rad), with the same states.
    law : LinearLaw
    late : (int, int)
        Samples of the law by which motor's and load's readings are late.
    """

    motor: LinearSystem
    load: LinearSystem
    law: LinearLaw
    late: tuple[int, int] = (0, 0)

    @property
    def _plant(self) -> _ReadPlant:
        """The plant in continuous time."""
        return _ReadPlant(self.load.A, self.load.B, np.stack([self.motor.C, self.load.C]))

    def _opened(self, plant: _ReadPlant, law: LawMatrices) -> LinearSystem:
        """Command in to minus command out, of a plant in continuous or in sampled time."""
        A, B, readings = plant
        size, n = B.size, law.C.size
        matrix = np.zeros((size + n, size + n))
        matrix[:size, :size], matrix[size:, size:] = A, law.A
        matrix[size:, :size] = law.B[:, 1:] @ readings
        row = -np.concatenate([law.D[1:] @ readings, law.C])
        return LinearSystem(matrix, np.append(B, np.zeros(n)), row, 0.0, _NO_POLYNOMIAL, _NO_POLYNOMIAL)

    def _closed(self, plant: _ReadPlant, law: LawMatrices) -> LinearSystem:
        """Reference to the controlled measurement, whose error the dead zone looks at."""
        opened = self._opened(plant, law)
        matrix = opened.A - np.outer(opened.B, opened.C)
        drive = opened.B * law.D[0]
        drive[plant.B.size :] += law.B[:, 0]
        row = np.append(np.array(self.law.error) @ plant.readings, np.zeros(law.C.size))
        return LinearSystem(matrix, drive, row, 0.0, _NO_POLYNOMIAL, _NO_POLYNOMIAL)

    def open(self) -> LinearSystem:
        """Open loop in continuous time, cut at the command.

        Raises
        ------
        InvalidInput
            The law has discrete matrices.
        """
        self._check_continuous()
        return self._opened(self._plant, law_matrices(self.law))

    def closed(self) -> LinearSystem:
        """Reference to the controlled measurement in continuous time (m or rad).

        Raises
        ------
        InvalidInput
            The law has discrete matrices.
        """
        self._check_continuous()
        return self._closed(self._plant, law_matrices(self.law))

    def _check_continuous(self) -> None:
        if self.law.discrete:
            raise InvalidInput("law discrete = True: its loop has no continuous-time system; `margins` takes it")

    def _held_plant(self) -> _ReadPlant:
        """The plant from tick to tick, with the lines in which readings of late encoders wait."""
        assert self.law.sample_rate is not None
        A, B = zero_order_hold(self.load.A, self.load.B, 1.0 / self.law.sample_rate)
        rows = self._plant.readings[:, None]
        whole, drive, readings = late_readings(A[None], B[None], list(rows), self.late)
        return _ReadPlant(whole[0], drive[0], np.concatenate(readings))

    def sampled_poles(self) -> Complex:
        """Poles z of the sampled loop; stable when all abs(z) < 1."""
        return self._closed(self._held_plant(), ticked_law(self.law)).poles()

    def slowest_pole(self) -> complex:
        """The closed loop's pole with the largest real part, 1/s; of a sampled loop log(z) times the rate."""
        if self.law.sample_rate is None:
            poles = self.closed().poles()
            return complex(poles[np.argmax(poles.real)])
        poles = self.sampled_poles()
        return complex(np.log(poles[np.argmax(np.abs(poles))]) * self.law.sample_rate)

    def margins(self) -> Margins:
        """All crossovers and margins, cut at the command.

        Of a law with discrete matrices, or with late encoders, sampled and up to half its rate. The bandwidth is that
        of the controlled measurement.
        """
        if self.law.discrete or any(self.late):
            return self._sampled_margins()
        opened, closed = self.open(), self.closed()
        corners = np.concatenate([opened.poles(), closed.poles(), _zeros(opened)])
        return margins_of_response(
            opened.response,
            _above_integrators(search_frequencies(also=corners), corners),
            stable=closed.is_stable(),
            closed_loop=closed.response,
            at_rest=float(np.abs(closed.response(0.0))),
        )

    def _sampled_margins(self) -> Margins:
        assert self.law.sample_rate is not None
        rate, plant, law = self.law.sample_rate, self._held_plant(), ticked_law(self.law)
        opened, closed = self._opened(plant, law), self._closed(plant, law)
        corners = np.concatenate([opened.poles(), closed.poles(), _zeros(opened)])
        corners = np.log(corners[np.abs(corners) > 0.0]) * rate
        omega = _above_integrators(search_frequencies(also=corners), corners)
        omega = np.append(omega[omega < math.pi * rate * (1.0 - 1e-9)], math.pi * rate * (1.0 - 1e-9))

        def on_circle(system: LinearSystem, w: Array) -> Complex:
            return system._response_of_states(np.exp(1j * np.asarray(w) / rate))

        return margins_of_response(
            lambda w: on_circle(opened, w),
            omega,
            stable=bool(np.all(np.abs(closed.poles()) < 1.0)),
            closed_loop=lambda w: on_circle(closed, w),
            at_rest=float(np.abs(on_circle(closed, np.zeros(1))[0])),
        )

    def check(self, described: str) -> None:
        """Refuse a law, as described, that does not stabilise the plant, at its sample rate if it has one.

        Raises
        ------
        InvalidInput
            With the fastest growing pole.
        """
        worst = self.slowest_pole()
        if not worst.real < 0.0:
            raise InvalidInput(
                f"the controller {described} is unstable on this axis even without a gap: its closed loop has "
                f"a pole at {worst.real:.3g}{worst.imag:+.3g}j 1/s, and every pole must have a negative real part"
            )


def _above_integrators(omega: Array, corners: Complex) -> Array:
    """Frequencies of a search without those that belong to poles which are zero but for rounding."""
    sizes = np.abs(corners)
    least = float(sizes[sizes > _INTEGRATOR * sizes.max()].min())
    return omega[omega >= 1e-2 * least]


def _zeros(system: LinearSystem) -> Complex:
    """Finite zeros, by the pencil of the system's matrices."""
    from scipy.linalg import eigvals, matrix_balance

    A, scaling = matrix_balance(system.A)
    B, C = np.linalg.solve(scaling, system.B), system.C @ scaling
    size = B.size
    pencil = np.zeros((size + 1, size + 1))
    pencil[:size, :size], pencil[:size, size], pencil[size, :size], pencil[size, size] = A, B, C, system.D
    masses = np.eye(size + 1)
    masses[size, size] = 0.0
    with np.errstate(all="ignore"):
        found = eigvals(pencil, masses)
    # A zero at infinity comes out infinite or huge.
    largest = _ZERO_AT_INFINITY * max(float(np.abs(A).max()), 1.0)
    return np.asarray(found[np.isfinite(found) & (np.abs(found) < largest)], dtype=complex)
