"""Names of the states of the servo's automaton, the rows that pick them, and guards made of such rows."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np

from servotwin.plant.actuator import ShaftMatrices
from servotwin.plant.signals import Array
from servotwin.plant.structure import Chain


class BacklashKind(Enum):
    """Kinds of backlash: what the driven side does inside the gap, and whether the load acts back on the motor."""

    RIGID = "rigid"
    """A rigid screw, held in the gap, whose load does not act back (the paper's)."""
    HELD = "held"
    """An elastic screw, held in the gap; in contact the load acts back."""
    FREE = "free"
    """An elastic shaft without mass or friction: inside the gap no force passes (the two-mass system with a dead zone
    of Nordin and Gutman)."""


class Stribeck(NamedTuple):
    """Friction above Coulomb's near standstill: it falls linearly with the speed, to none at a speed of its own.

    Attributes
    ----------
    drop : float
        Static less Coulomb friction, N m (of a linear load N).
    speed : float
        Speed at which nothing of it is left, rad/s (m/s).
    slope : float, or (P, 1) array
        drop / speed; 0: there is none.
    """

    drop: float = 0.0
    speed: float = 0.0
    slope: float | Array = 0.0

    @staticmethod
    def of(static: float | None, coulomb: float, speed: float | None) -> Stribeck:
        """From static and Coulomb friction; None or no drop: none."""
        if static is None or speed is None or static == coulomb:
            return Stribeck()
        return Stribeck(static - coulomb, speed, (static - coulomb) / speed)


class Guide(NamedTuple):
    """Forces on the last mass beside those of its neighbours: of a linear load N, of a rotary one N m.

    Attributes
    ----------
    friction : float
        Coulomb friction.
    force : float
        Constant, gravity for one; positive pushes forwards.
    mass : float, or (P, 1) array
        The last mass, kg or kg m^2.
    yielding : float, or (P, 1) array
        m/s (rad/s) that a force of one N (N m) takes off the last mass's speed in its own time.
    stribeck : Stribeck
        Friction above Coulomb's near standstill.
    """

    friction: float = 0.0
    force: float = 0.0
    mass: float | Array = 1.0
    yielding: float | Array = 1.0
    stribeck: Stribeck = Stribeck()


class PlantNumbers(Protocol):
    """Numbers of a plant that its automaton needs: of one, or of many with one structure on leading axes."""

    @property
    def n(self) -> int:
        """Number of masses."""
        ...

    @property
    def backlash_kind(self) -> BacklashKind:
        """Kind of the backlash."""
        ...

    @property
    def p(self) -> float | Array:
        """m/rad; (P, 1) for many plants, as the others."""
        ...

    @property
    def guide(self) -> Guide:
        """Forces on the last mass."""
        ...

    @property
    def motor_stribeck(self) -> Stribeck:
        """Friction of the motor's shaft above Coulomb's near standstill."""
        ...

    @property
    def command_limit(self) -> float | None:
        """Largest command that the drive follows, either sign; None: any."""
        ...

    @property
    def at_motor(self) -> bool:
        """True where the controller acts on the motor's encoder instead of the load's."""
        ...

    def chain(self) -> Chain:
        """Matrices of the structure."""
        ...

    def shaft(self) -> ShaftMatrices:
        """Matrices of the actuator."""
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
    def release(self) -> float | Array:
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

    def chain_states(self, chain: Chain) -> slice:
        """Places of the structure's states, which follow the screw's."""
        first = self["theta_d"] + 1
        return slice(first, first + chain.A.shape[-1])

    def last_speed(self, servo: PlantNumbers) -> int:
        """Place of the last mass's speed, which must be a state."""
        return self.chain_states(servo.chain()).stop - 1

    def positions(self, servo: PlantNumbers) -> Array:
        """(..., n, states) rows of the masses' positions."""
        chain = servo.chain()
        rows = np.zeros((*np.shape(servo.p)[:-1], servo.n, len(self.names)))
        rows[..., self.chain_states(chain)] = chain.C
        rows[..., self["theta_d"]] += chain.D * servo.p
        return rows

    def sensed(self, servo: PlantNumbers) -> Array:
        """(..., states) row of the position that the controller's sensor sees."""
        return self.row("sensed") if "sensed" in self else self.sensed_of(servo)

    def sensed_of(self, servo: PlantNumbers) -> Array:
        """The same by the states of motor and load."""
        if servo.at_motor:
            return np.asarray(servo.p * self.row("theta_m"))
        return np.asarray(self.positions(servo)[..., -1, :])


def rows_times(row: Array, matrices: Array) -> Array:
    """(..., n) products of rows (..., m) and matrices (..., m, n)."""
    return np.asarray((row[..., None, :] @ matrices)[..., 0, :])


def plant_names(servo: PlantNumbers) -> list[str]:
    """States of motor, screw and structure."""
    return [*servo.shaft().names, "theta_d", *(f"chain{i}" for i in range(servo.chain().A.shape[-1]))]


def input_names(key: str, order: int) -> list[str]:
    """An input that is a polynomial of degree `order`: its value and derivatives."""
    return [key + "'" * k for k in range(order + 1)]
