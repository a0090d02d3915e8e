"""The linear loop without a gap, composed of its parts: motor, structure, controller, loop filter (Eqs 8-15).

In continuous time as a `LinearSystem`; at a sample rate as the poles of one tick: zero-order hold on the plant, the
edge's own tick as the law.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from servotwin.control.controller import Controller
from servotwin.control.law import LawState, tick
from servotwin.control.laws import filtered_pid
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import ShaftMatrices, ShaftPolynomials
from servotwin.plant.linear import (
    Complex,
    LinearSystem,
    feedback,
    gain,
    integrator,
    lag,
    minus,
    parallel,
    plus,
    series,
    times,
    zero_order_hold,
)
from servotwin.plant.motor import ANGLE, SPEED, Motor
from servotwin.plant.signals import Array
from servotwin.plant.structure import Structure, chain, transfer


def motor_system(motor: Motor) -> LinearSystem:
    """G1, voltage to the unloaded motor's angle (Eq 8)."""
    A, B, _ = motor.matrices()
    numerator, denominator = motor.transfer()
    return LinearSystem(A, B, np.eye(3)[ANGLE], 0.0, numerator, denominator)


def structure_system(structure: Structure, pitch: float) -> LinearSystem:
    """G2, angle of the screw to the position of the last mass (Eq 13 for n = 3), for a pitch in m/rad.

    The input's derivative is absorbed by the state: z = x - B_velocity d.
    """
    links = chain(structure.m, structure.k, structure.c, structure.k_d)
    B = pitch * (links.B_position + links.A @ links.B_velocity)
    numerator, denominator, _ = transfer(structure.m, structure.k, structure.c, structure.k_d)
    return LinearSystem(links.A, B, links.C_last, pitch * float(links.D[-1]), pitch * numerator, denominator)


@np.errstate(over="ignore", invalid="ignore")
def plant_system(motor: Motor, structure: Structure, pitch: float) -> LinearSystem:
    """Voltage to the position of the last mass without a gap.

    With a rigid screw G1 G2. With an elastic one (finite k_d) the load acts on the motor: the screw's force F turns it
    back with the torque p F.
    """
    if math.isinf(structure.k_d):
        return series(motor_system(motor), structure_system(structure, pitch))
    links = chain(structure.m, structure.k, structure.c, structure.k_d)
    A_m, B_m, E = motor.matrices()
    size = links.B_position.size
    A = np.zeros((3 + size, 3 + size))
    A[:3, :3], A[3:, 3:] = A_m, links.A
    A[3:, ANGLE] = pitch * links.B_position
    A[SPEED, 3:] = -pitch * E[SPEED] * links.reaction
    A[SPEED, ANGLE] = -pitch * E[SPEED] * links.reaction_position * pitch
    B = np.concatenate([B_m, np.zeros(size)])
    C = np.concatenate([np.zeros(3), links.C_last])
    # (L s + R)(J s^2 theta + p F) = k_T (u - k_B s theta), F = k_d p theta (1 - k_d inner / whole).
    numerator, whole, inner = transfer(structure.m, structure.k, structure.c, structure.k_d)
    electric = np.array([motor.R, motor.L])
    reaction = pitch**2 * structure.k_d * minus(whole, structure.k_d * inner)
    mechanical = plus(times(np.array([0.0, 0.0, motor.J]), whole), reaction)
    back_emf = times(np.array([0.0, motor.k_T * motor.k_B]), whole)
    denominator = plus(times(electric, mechanical), back_emf)
    return LinearSystem(A, B, C, 0.0, motor.k_T * pitch * numerator, denominator)


@np.errstate(over="ignore", invalid="ignore")
def axis_system(
    shaft: ShaftMatrices, polynomials: ShaftPolynomials, structure: Structure, pitch: float, at_motor: bool
) -> LinearSystem:
    """Command of an actuator to the position of the last mass without a gap, or to that of the motor times the pitch.

    With a rigid transmission the load does not act back. With an elastic one its force F = (c_d s + k_d) (d - q_1)
    turns the motor back with the torque pitch F.
    """
    d = len(shaft.names)
    motor = LinearSystem(shaft.A, shaft.B, np.eye(d)[-1], 0.0, polynomials.command, polynomials.shaft)
    if math.isinf(structure.k_d):
        return series(motor, gain(pitch) if at_motor else structure_system(structure, pitch))
    links = chain(*structure)
    size = links.B_position.size
    force = np.concatenate([np.zeros(d), links.reaction])
    force[d - 2 : d] += pitch * np.array([structure.c_d, structure.k_d])
    A = np.zeros((d + size, d + size))
    A[:d, :d], A[d:, d:] = shaft.A, links.A
    A[d:, d - 1], A[d:, d - 2] = pitch * links.B_position, pitch * links.B_velocity
    A[:d] -= pitch * np.outer(shaft.E, force)
    above, whole, inner = transfer(*structure)
    screw = np.array([structure.k_d, structure.c_d]) if structure.c_d else np.array([structure.k_d])
    reaction = pitch**2 * times(screw, minus(whole, times(screw, inner)))
    denominator = plus(times(polynomials.shaft, whole), times(polynomials.torque, reaction))
    C = np.concatenate([np.zeros(d), links.C_last])
    if at_motor:
        C, above = pitch * np.eye(d + size)[d - 1], whole
    numerator = pitch * times(polynomials.command, above)
    return LinearSystem(A, np.concatenate([shaft.B, np.zeros(size)]), C, 0.0, numerator, denominator)


def gain_units(command: str, position: str) -> tuple[str, str, str, str]:
    """Units of Kp, Ki, Kd and Tf of a filtered PID, for those of its command and of the position."""
    return f"{command}/{position}", f"{command}/({position} s)", f"{command} s/{position}", "s"


@contextmanager
def computable(described: Callable[[], Mapping[str, Mapping[str, Any]]]) -> Iterator[None]:
    """Refuse numbers of which no loop can be computed, as those of no machine: the message names the most extreme one.

    Parameters
    ----------
    described : callable
        The tables of the plant's file, with its controller's.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except (np.linalg.LinAlgError, OverflowError):
        sizes = {
            f"{table}.{key} = {each!r}": abs(math.log10(abs(each)))
            for table, values in described().items()
            for key, value in values.items()
            for each in (value if isinstance(value, list | tuple) else [value])
            if isinstance(each, float) and math.isfinite(each) and each != 0.0
        }
        raise InvalidInput(
            f"the loop cannot be computed; farthest from 1 is {max(sizes, key=sizes.__getitem__)}: check its unit"
        ) from None


def check_stable(
    plant: LinearSystem, law: Controller, described: str, command: str = "V", position: str = "m", late: int = 0
) -> None:
    """Refuse a controller that does not stabilise a plant, at its sample rate if it has one.

    Parameters
    ----------
    described : str
        The plant in words.
    command, position : str
        Units of the gains.
    late : int
        Samples by which the readings of the position are late.

    Raises
    ------
    InvalidInput
        With the fastest growing pole.
    """
    worst = slowest_pole(plant, law, late)
    if not worst.real < 0.0:
        rate = "" if law.sample_rate is None else f" at {law.sample_rate:g} Hz"
        units = gain_units(command, position)
        names = ("Kp", "Ki", "Kd", "Tf")
        gains = ", ".join(f"{name} = {getattr(law, name):g} {unit}" for name, unit in zip(names, units, strict=True))
        raise InvalidInput(
            f"the controller with {gains}{rate} is unstable on this {described} even without a gap: "
            f"its closed loop has a pole at {worst.real:.3g}{worst.imag:+.3g}j 1/s, "
            "and every pole must have a negative real part"
        )


def pidf(controller: Controller) -> LinearSystem:
    """C_PIDF = Kp + Ki/s + Kd s/(Tf s + 1) (Eq 14) and the notch behind it; terms whose gain is zero have no state."""
    controller = filtered_pid(controller)
    system = gain(controller.Kp)
    if controller.Ki != 0.0:
        system = parallel(system, integrator(controller.Ki))
    if controller.Kd != 0.0:
        rate = controller.Kd / controller.Tf
        system = parallel(system, parallel(gain(rate), lag(-rate, controller.Tf)))
    return series(system, notch(controller)) if controller.notch_hz else system


def notch(controller: Controller) -> LinearSystem:
    """Notch on the PIDF's voltage, or 1 where there is none."""
    if controller.notch_hz == 0.0:
        return gain(1.0)
    omega, poles = 2.0 * math.pi * controller.notch_hz, controller.notch_damping
    A = omega * np.array([[-2.0 * poles, -1.0], [1.0, 0.0]])
    zeros = poles * controller.notch_depth
    numerator, denominator = (np.array([omega * omega, 2.0 * zeta * omega, 1.0]) for zeta in (zeros, poles))
    return LinearSystem(A, np.array([omega, 0.0]), np.array([-controller.notch_gain, 0.0]), 1.0, numerator, denominator)


def loop_filter(controller: Controller) -> LinearSystem:
    """First-order low-pass on the measurement (section 4.3), or 1 where there is none."""
    if controller.loop_filter_hz is None:
        return gain(1.0)
    return lag(1.0, 1.0 / (2.0 * math.pi * controller.loop_filter_hz))


def open_loop(plant: LinearSystem, controller: Controller) -> LinearSystem:
    """L = C_PIDF P and, where the controller has one, the loop filter."""
    return series(series(pidf(controller), plant), loop_filter(controller))


def closed_loop(plant: LinearSystem, controller: Controller) -> LinearSystem:
    """Reference to measured position (Eq 15), without velocity feedforward; the loop filter is in the feedback."""
    return feedback(series(pidf(controller), plant), loop_filter(controller))


class StateMatrices(NamedTuple):
    """x' = A x + B y, minus the voltage = C x + D y; of a sampled law x' is the next x."""

    A: Array
    B: Array
    C: Array
    D: float


def continuous_law(controller: Controller) -> StateMatrices:
    """Loop filter and PIDF, from the measurement to minus the voltage."""
    law = series(loop_filter(controller), pidf(controller))
    return StateMatrices(law.A, law.B, law.C, law.D)


def sampled_law(controller: Controller) -> StateMatrices:
    """One tick of the law, from the measurement to minus the voltage; with limits and dead zone off it is linear.

    The matrices come from applying the edge's own tick to unit states and to a unit measurement.

    Raises
    ------
    InvalidInput
        The controller is continuous.
    """
    controller = filtered_pid(controller)
    if controller.sample_rate is None:
        raise InvalidInput("controller sample_rate = None: a sampled loop needs a rate in Hz")
    law = controller.replace(voltage_limit=None, rate_limit=None, feedforward=0.0).law(None)
    names = ["derivative"] + ["integral"] * bool(controller.Ki) + ["filtered"] * (law.loop_step < 1.0)
    names += ["notch_band", "notch_low"] * (law.notch_gain != 0.0)
    rest = LawState(0.0, 0.0, 0.0, 0.0, 1.0)
    starts = [rest._replace(**{name: 1.0}) for name in names]
    ticks = [tick(law, start, 0.0, 0.0) for start in starts] + [tick(law, rest, 0.0, 1.0)]
    moved = np.array([[getattr(after, name) for after in ticks] for name in names])
    voltage = np.array([after.voltage for after in ticks])
    return StateMatrices(moved[:, :-1], moved[:, -1], -voltage[:-1], -float(voltage[-1]))


def sampled_poles(plant: LinearSystem, controller: Controller, delay: int = 0) -> Complex:
    """Poles z of the sampled loop: eigenvalues of plant, law and `delay` samples over one tick; stable when all
    abs(z) < 1."""
    law = sampled_law(controller)
    assert controller.sample_rate is not None
    advance, drive = zero_order_hold(plant.A, plant.B, 1.0 / controller.sample_rate)
    size, states = plant.B.size, len(law.A)
    matrix = np.zeros((size + states + delay, size + states + delay))
    matrix[:size, :size], matrix[size : size + states, size : size + states] = advance, law.A
    matrix[size : size + states, :size] = np.outer(law.B, plant.C)
    voltage = np.concatenate([-law.D * plant.C, -law.C, np.zeros(delay)])
    if delay == 0:
        matrix[:size] += np.outer(drive, voltage)
    else:
        matrix[:size, -1] = drive
        matrix[size + states] = voltage
        matrix[size + states + 1 :, size + states : -1] = np.eye(delay - 1)
    return np.asarray(np.linalg.eigvals(matrix), dtype=complex)


def slowest_pole(plant: LinearSystem, controller: Controller, late: int = 0) -> complex:
    """The closed loop's pole with the largest real part, 1/s; of a sampled loop, whose sensor is `late` samples late,
    log(z) times the rate."""
    if controller.sample_rate is None:
        poles = closed_loop(plant, controller).poles()
        return complex(poles[np.argmax(poles.real)])
    poles = sampled_poles(plant, controller, late)
    return complex(np.log(poles[np.argmax(np.abs(poles))]) * controller.sample_rate)
