"""Actuators: what turns the command of a controller into the motion of the motor's shaft."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np

from servotwin.config.keys import check, items_of, key, settings
from servotwin.plant.linear import product
from servotwin.plant.numbers import check_stribeck
from servotwin.plant.signals import Array

SHAFT_KEYS = ("coulomb_friction_n_m", "static_friction_n_m", "stribeck_speed_rad_per_s", "N m")
"""Keys of the friction of a shaft: Coulomb, static, Stribeck speed; and the unit of the first two."""


class ShaftMatrices(NamedTuple):
    """x' = A x + B u + E torque of an actuator with its shaft; many actuators' on leading axes.

    Attributes
    ----------
    names : tuple of str
        States; the last two are "speed" (rad/s) and "theta_m" (rad).
    A, B, E : (..., d, d), (..., d), (..., d) arrays
        B is the column of the command, E that of an external torque on the shaft (N m, positive accelerates).
    torque : (..., d) array
        Row of the actuator's own torque on the shaft, N m.
    direct : float or (...) array
        N m per unit of the command, beside that row.
    yielding : float or (...) array
        rad/s that a torque of one N m takes off the speed in the actuator's own time.
    """

    names: tuple[str, ...]
    A: Array
    B: Array
    E: Array
    torque: Array
    direct: float | Array
    yielding: float | Array


class ShaftPolynomials(NamedTuple):
    """shaft(s) theta_m = command(s) u + torque(s) tau, ascending powers of s, tau an external torque on the shaft."""

    shaft: Array
    command: Array
    torque: Array


_STATIC = key(
    "static_friction_n_m",
    above=0.0,
    help="Friction of the shaft at standstill; absent: the Coulomb friction.",
)
_STRIBECK = key(
    "stribeck_speed_rad_per_s",
    above=0.0,
    help="Speed at which the friction has fallen, linearly, from the static to the Coulomb friction.",
)


def _checked(actuator: object) -> None:
    """Refuse values out of their range, and make floats of the others."""
    check(actuator)
    for item in items_of(type(actuator)):
        given = getattr(actuator, item.name)
        object.__setattr__(actuator, item.name, None if given is None else float(given))


def _check_friction(actuator: DcMotor | TorqueDrive) -> None:
    check_stribeck("actuator", actuator.coulomb, actuator.static, actuator.stribeck, SHAFT_KEYS)


@settings("actuator")
@dataclass(frozen=True)
class DcMotor:
    """DC motor behind a voltage (Eqs 1-8).

    L I' + R I = u - k_B omega, J omega' = k_T I + torque.

    Raises
    ------
    InvalidInput
        A value out of its range.
    """

    J: Annotated[float, key("inertia_kg_m2", above=0.0, help="Inertia of the rotor and of all that turns with it.")]
    R: Annotated[float, key("resistance_ohm", above=0.0, help="Resistance of the winding.")]
    k_T: Annotated[float, key("torque_gain_n_m_per_a", above=0.0, help="Torque per current.")]
    k_B: Annotated[float, key("back_emf_v_s_per_rad", above=0.0, help="Back-EMF per angular velocity.")]
    L: Annotated[
        float, key("inductance_h", minimum=0.0, help="Inductance of the winding; 0: the current follows at once.")
    ] = 0.0
    friction: Annotated[
        float, key("viscous_friction_n_m_s_per_rad", minimum=0.0, help="Viscous friction of the shaft.")
    ] = 0.0
    coulomb: Annotated[float, key("coulomb_friction_n_m", minimum=0.0, help="Coulomb friction of the shaft.")] = 0.0
    static: Annotated[float | None, _STATIC] = None
    stribeck: Annotated[float | None, _STRIBECK] = None
    limit: Annotated[
        float | None,
        key("voltage_limit_v", above=0.0, help="Largest voltage of the drive, either sign; absent: no limit."),
    ] = None

    unit = "V"

    def __post_init__(self) -> None:
        _checked(self)
        _check_friction(self)

    def matrices(self) -> ShaftMatrices:
        """Matrices of (current, speed, theta_m); without inductance of (speed, theta_m)."""
        J, L, R, k_T, k_B = self.J, self.L, self.R, self.k_T, self.k_B
        yielding = R / (k_T * k_B + R * self.friction)
        if L == 0.0:
            drag = k_T * k_B / R
            A = np.array([[-(drag + self.friction) / J, 0.0], [1.0, 0.0]])
            B, E, torque = np.array([k_T / (R * J), 0.0]), np.array([1.0 / J, 0.0]), np.array([-drag, 0.0])
            return ShaftMatrices(("speed", "theta_m"), A, B, E, torque, k_T / R, yielding)
        A = np.array([[-R / L, -k_B / L, 0.0], [k_T / J, -self.friction / J, 0.0], [0.0, 1.0, 0.0]])
        B, E, torque = np.array([[1.0 / L, 0.0, 0.0], [0.0, 1.0 / J, 0.0], [k_T, 0.0, 0.0]])
        return ShaftMatrices(("current", "speed", "theta_m"), A, B, E, torque, 0.0, yielding)

    def scaled(self, torque: float, drag: float) -> DcMotor:
        """A copy with other factors on torque gain and back EMF."""
        return replace(self, k_T=self.k_T * torque, k_B=self.k_B * drag)

    def polynomials(self) -> ShaftPolynomials:
        """Voltage and torque to the angle (Eq 8)."""
        electric = np.array([self.R, self.L]) if self.L > 0.0 else np.array([self.R])
        shaft = product([electric, np.array([0.0, self.friction, self.J])])
        shaft[1] += self.k_T * self.k_B
        return ShaftPolynomials(shaft, np.array([self.k_T]), electric)


@settings("actuator")
@dataclass(frozen=True)
class TorqueDrive:
    """Motor behind a current loop, whose command is a torque.

    J omega' = torque - friction omega, with a first-order lag from command to torque.

    Raises
    ------
    InvalidInput
        A value out of its range.
    """

    J: Annotated[float, key("inertia_kg_m2", above=0.0, help="Inertia of the rotor and of all that turns with it.")]
    lag: Annotated[
        float, key("current_loop_time_s", minimum=0.0, help="Time constant of the current loop; 0: none.")
    ] = 0.0
    friction: Annotated[
        float, key("viscous_friction_n_m_s_per_rad", minimum=0.0, help="Viscous friction of the shaft.")
    ] = 0.0
    coulomb: Annotated[float, key("coulomb_friction_n_m", minimum=0.0, help="Coulomb friction of the shaft.")] = 0.0
    gain: Annotated[
        float, key("torque_per_command", above=0.0, help="Torque per commanded torque; 1: the drive is calibrated.")
    ] = 1.0
    static: Annotated[float | None, _STATIC] = None
    stribeck: Annotated[float | None, _STRIBECK] = None
    limit: Annotated[
        float | None,
        key(
            "torque_limit_n_m",
            above=0.0,
            help="Largest command that the drive follows, its current limit for one, either sign; absent: any.",
        ),
    ] = None

    unit = "N m"

    def __post_init__(self) -> None:
        _checked(self)
        _check_friction(self)

    def matrices(self) -> ShaftMatrices:
        """Matrices of (torque, speed, theta_m); without lag of (speed, theta_m)."""
        J, drag = self.J, self.friction
        # In the current loop's time, or until friction limits it; a shaft without either never stops by itself.
        times = [self.lag / J] if self.lag > 0.0 else []
        yielding = min([*times, 1.0 / drag] if drag > 0.0 else times, default=1.0 / J)
        if self.lag == 0.0:
            A = np.array([[-drag / J, 0.0], [1.0, 0.0]])
            column = np.array([1.0 / J, 0.0])
            return ShaftMatrices(("speed", "theta_m"), A, self.gain * column, column, np.zeros(2), self.gain, yielding)
        A = np.array([[-1.0 / self.lag, 0.0, 0.0], [1.0 / J, -drag / J, 0.0], [0.0, 1.0, 0.0]])
        B, E, torque = np.array([[self.gain / self.lag, 0.0, 0.0], [0.0, 1.0 / J, 0.0], [1.0, 0.0, 0.0]])
        return ShaftMatrices(("torque", "speed", "theta_m"), A, B, E, torque, 0.0, yielding)

    def scaled(self, torque: float, drag: float) -> TorqueDrive:
        """A copy with other factors on the torque per command and on the viscous friction."""
        return replace(self, friction=self.friction * drag, gain=self.gain * torque)

    def polynomials(self) -> ShaftPolynomials:
        """Torque command and torque to the angle."""
        lag = np.array([1.0, self.lag]) if self.lag > 0.0 else np.array([1.0])
        return ShaftPolynomials(product([lag, np.array([0.0, self.friction, self.J])]), np.array([self.gain]), lag)


@settings("actuator")
@dataclass(frozen=True)
class VelocityDrive:
    """Drive in velocity mode: its shaft follows the commanded speed with a first-order lag, whatever the load.

    Raises
    ------
    InvalidInput
        A value out of its range.
    """

    lag: Annotated[float, key("velocity_loop_time_s", above=0.0, help="Time constant of the drive's velocity loop.")]
    limit: Annotated[
        float | None,
        key(
            "speed_limit_rad_per_s", above=0.0, help="Largest command that the drive follows, either sign; absent: any."
        ),
    ] = None

    unit, coulomb, static, stribeck = "rad/s", 0.0, None, None

    def __post_init__(self) -> None:
        _checked(self)

    def matrices(self) -> ShaftMatrices:
        """Matrices of (speed, theta_m)."""
        A, B = np.array([[-1.0 / self.lag, 0.0], [1.0, 0.0]]), np.array([1.0 / self.lag, 0.0])
        return ShaftMatrices(("speed", "theta_m"), A, B, np.zeros(2), np.zeros(2), 0.0, 0.0)

    def scaled(self, torque: float, drag: float) -> VelocityDrive:  # noqa: ARG002
        """Itself: it follows its command."""
        return self

    def polynomials(self) -> ShaftPolynomials:
        """Speed command to the angle."""
        return ShaftPolynomials(np.array([0.0, 1.0, self.lag]), np.array([1.0]), np.zeros(1))


@settings("actuator")
@dataclass(frozen=True)
class Stepper:
    """Stepper motor: the shaft goes to the commanded angle, whatever the load, as its driver smooths the steps.

    Raises
    ------
    InvalidInput
        A value out of its range.
    """

    smoothing: Annotated[
        float,
        key("smoothing_time_s", above=0.0, help="Time constant (twice) of the driver's smoothing between two steps."),
    ]

    unit, coulomb, static, stribeck, limit = "rad", 0.0, None, None, None

    def __post_init__(self) -> None:
        _checked(self)

    def matrices(self) -> ShaftMatrices:
        """Matrices of (speed, theta_m)."""
        rate = 1.0 / self.smoothing
        A, B = np.array([[-2.0 * rate, -rate * rate], [1.0, 0.0]]), np.array([rate * rate, 0.0])
        return ShaftMatrices(("speed", "theta_m"), A, B, np.zeros(2), np.zeros(2), 0.0, 0.0)

    def scaled(self, torque: float, drag: float) -> Stepper:  # noqa: ARG002
        """Itself: it follows its command."""
        return self

    def polynomials(self) -> ShaftPolynomials:
        """Commanded angle to the angle."""
        slow = np.array([1.0, self.smoothing])
        return ShaftPolynomials(product([slow, slow]), np.array([1.0]), np.zeros(1))


Actuator: TypeAlias = DcMotor | TorqueDrive | VelocityDrive | Stepper
ACTUATORS = {"dc_motor": DcMotor, "torque": TorqueDrive, "velocity": VelocityDrive, "stepper": Stepper}


def static_torque(actuator: Actuator) -> float:
    """Torque at rest per command, N m; 0 for a drive that follows its command whatever the load."""
    shaft = actuator.polynomials()
    return float(shaft.command[0]) / float(shaft.torque[0]) if shaft.torque[0] else 0.0


def stacked(every: Sequence[ShaftMatrices]) -> ShaftMatrices:
    """Matrices of many actuators with the same states, on a leading axis; their numbers as (P, 1)."""
    columns = [np.stack([np.asarray(each[i], dtype=float) for each in every]) for i in range(1, len(every[0]))]
    A, B, E, torque, direct, yielding = columns
    return ShaftMatrices(every[0].names, A, B, E, torque, direct[:, None], yielding[:, None])
