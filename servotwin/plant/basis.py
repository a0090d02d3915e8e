"""Names of the states of the servo's automaton, the rows that pick them, and guards made of such rows."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from servotwin.plant.signals import Array
from servotwin.plant.structure import Chain


class PlantNumbers(Protocol):
    """Numbers of a plant that its automaton needs: of one, or of many with one structure on leading axes."""

    @property
    def n(self) -> int:
        """Number of masses."""
        ...

    @property
    def rigid(self) -> bool:
        """True when the first mass follows the screw."""
        ...

    @property
    def k_d(self) -> float | Array:
        """N/m, stiffness of the screw."""
        ...

    @property
    def p(self) -> float | Array:
        """m/rad; (P, 1) for many plants, as the others."""
        ...

    @property
    def R(self) -> float | Array:
        """Resistance of the winding, ohm."""
        ...

    @property
    def k_T(self) -> float | Array:
        """Torque per current, N m/A."""
        ...

    @property
    def k_B(self) -> float | Array:
        """Back-EMF per angular velocity, V s/rad."""
        ...

    def chain(self) -> Chain:
        """Matrices of the structure."""
        ...

    def motor(self) -> tuple[Array, Array, Array]:
        """Matrices of the motor."""
        ...


class LawNumbers(Protocol):
    """Numbers of a continuous law that its automaton needs: of one, or (P, 1) of many."""

    @property
    def Kp(self) -> float | Array:
        """Proportional gain, V/m."""
        ...

    @property
    def Ki(self) -> float | Array:
        """Integral gain, V/(m s)."""
        ...

    @property
    def Kd(self) -> float | Array:
        """Derivative gain, V s/m."""
        ...

    @property
    def Tf(self) -> float | Array:
        """Time constant of the derivative's filter, s."""
        ...

    @property
    def enter(self) -> float | Array:
        """Error at which the loop opens, in tolerances."""
        ...

    @property
    def leave(self) -> float | Array:
        """Error at which it closes again, in tolerances."""
        ...

    @property
    def tracking(self) -> float | Array:
        """Time constant of the back-calculation, s."""
        ...

    @property
    def loop_filter_hz(self) -> float | Array | None:
        """Cut-off of the filter on the measurement."""
        ...

    @property
    def voltage_limit(self) -> float | Array | None:
        """V; None: none."""
        ...

    @property
    def integral_only(self) -> bool:
        """True where the dead zone stops the integral only."""
        ...

    @property
    def velocity_feedforward(self) -> float | Array:
        """Voltage per speed of the reference, V s/m."""
        ...

    @property
    def velocity_time(self) -> float | Array:
        """Time constant of its filter, s."""
        ...

    @property
    def notch_hz(self) -> float | Array:
        """Centre of the notch; 0: none."""
        ...

    @property
    def notch_damping(self) -> float | Array:
        """Damping ratio of its poles."""
        ...

    @property
    def notch_gain(self) -> float | Array:
        """Share of its band-pass that it takes away."""
        ...

    @property
    def release_time(self) -> float | Array:
        """Time constant of an offset, s."""
        ...


def outer(column: Array, row: Array) -> Array:
    """(..., m, n) outer products of (..., m) columns and (..., n) rows."""
    return np.asarray(column[..., :, None] * row[..., None, :])


def scaled(factor: float | Array, matrices: Array) -> Array:
    """Matrices (..., m, n) times a number, or (P, 1) numbers."""
    return np.asarray(np.asarray(factor)[..., None] * matrices)


class GuardRow(NamedTuple):
    """A guard of one component of the automaton: its row, the component's mode entered, reset, label and side."""

    row: Array
    target: str
    reset: Array | None
    label: str
    side: int


class Basis:
    """States of an automaton by name."""

    def __init__(self, names: tuple[str, ...]) -> None:
        # Spare states that never move: the kernel's products run over whole vectors of the machine.
        self.names = (*names, *(f"spare{i}" for i in range(-len(names) % 4)))
        self._index = {name: i for i, name in enumerate(self.names)}
        self._rows = np.vstack([np.eye(len(self.names)), np.zeros(len(self.names))])
        self._rows.setflags(write=False)

    def __getitem__(self, name: str) -> int:
        return self._index[name]

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def row(self, name: str) -> Array:
        """The row that picks a state, not to be written to; zero when there is no such state."""
        return np.asarray(self._rows[self._index.get(name, -1)])

    def positions(self, servo: PlantNumbers) -> Array:
        """(..., n, states) rows of the masses' positions."""
        chain = servo.chain()
        first = self["chain0"]
        rows = np.zeros((*np.shape(servo.p)[:-1], servo.n, len(self.names)))
        rows[..., first : first + chain.A.shape[-1]] = chain.C
        rows[..., self["theta_d"]] += chain.D * servo.p
        return rows


def plant_names(servo: PlantNumbers) -> list[str]:
    """States of motor, screw and structure."""
    return ["current", "speed", "theta_m", "theta_d", *(f"chain{i}" for i in range(servo.chain().A.shape[-1]))]


def input_names(key: str, order: int) -> list[str]:
    """An input that is a polynomial of degree `order`: its value and derivatives."""
    return [key + "'" * k for k in range(order + 1)]
