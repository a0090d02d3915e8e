"""Motor, screw and structure as parts of the automaton: backlash {-, open, +} times friction {stick, slip -, slip +}.

Per mode the flow of what moves, and the guards that end the mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.basis import Basis
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

# What ends a mode: (row, mode entered, reset, label, side).
Ending = tuple[Array, str, Array | None, str, int]


@dataclass(frozen=True)
class Play:
    """One mode of the backlash: pressed against the flank of a side, held there at rest, or open (side 0)."""

    name: str
    side: int
    held: bool = False


@dataclass(frozen=True)
class Grip:
    """One mode of the friction on the motor's shaft: stuck, sliding in a direction, or none at all (side 0)."""

    name: str
    side: int = 0
    stuck: bool = False


_RIGID = (Play("-", -1), Play("open", 0), Play("+", 1))
# A load that acts back would push a slow motor off its flank, and nothing would keep it off: between the two it rests
# there under part of the load (the sliding mode of this automaton).
_ELASTIC = (*_RIGID, Play("held -", -1, held=True), Play("held +", 1, held=True))
OPEN = 1
SMOOTH = (Grip(""),)
_HAIR = 1e-9
_COULOMB = (Grip("stick", stuck=True), Grip("slip -", -1), Grip("slip +", 1))


def plays(servo: Servo) -> tuple[Play, ...]:
    """The modes of the backlash."""
    return _RIGID if servo.rigid else _ELASTIC


def grips(servo: Servo, friction: bool) -> tuple[Grip, ...]:
    """The modes of the friction; the first is the one at rest."""
    if friction and not servo.rigid:
        raise InvalidInput(f"friction with a screw stiffness of k_d = {servo.k_d} N/m: needs a rigid screw (k_d = inf)")
    return _COULOMB if friction else SMOOTH


def flow_of(servo: Servo, basis: Basis, play: Play, grip: Grip, voltage: Array) -> Array:
    """(n, n) flow of motor, screw, chain and input chains in one mode; other rows are zero."""
    flow = np.zeros((len(basis.names), len(basis.names)))
    chain, (A, B, E) = servo.chain(), servo.motor()
    size, first, screw = chain.A.shape[0], basis["chain0"], basis["theta_d"]
    states = slice(first, first + size)
    flow[:3, :3] = A
    flow[:3] += np.outer(B, voltage + basis.row("input bias")) - np.outer(E, grip.side * basis.row("friction"))
    flow[screw] = _screw_rate(basis, 0 if play.held else play.side)
    flow[states, states] = chain.A
    flow[states] += servo.p * (
        np.outer(chain.B_position, basis.row("theta_d")) + np.outer(chain.B_velocity, flow[screw])
    )
    if play.held:
        flow[basis["speed"]] = 0.5 * play.side * basis.row("gap''")
    elif play.side:
        force = chain.reaction_position * servo.p * basis.row("theta_d")
        force[states] += chain.reaction
        flow[:3] -= servo.p * np.outer(E, force)
    if grip.stuck:
        flow[basis["speed"]] = 0.0
    for name in basis.names:
        if name + "'" in basis:
            flow[basis[name]] = basis.row(name + "'")
    return flow


def _screw_rate(basis: Basis, side: int) -> Array:
    """theta_d' of the play operator: with the motor, less the half gap's own rate, in contact; zero in the gap (errata
    E3, E4)."""
    if side == 0:
        return np.zeros(len(basis.names))
    return basis.row("speed") - 0.5 * side * basis.row("gap'")


def _contact_reset(servo: Servo, basis: Basis, side: int) -> Array:
    """Put the screw on its flank; the chain's damper turns a jump of the screw into one of velocity (Eq 10)."""
    reset = np.eye(len(basis.names))
    moved = basis.row("theta_m") - 0.5 * side * basis.row("gap") - basis.row("theta_d")
    chain = servo.chain()
    reset[basis["theta_d"]] += moved
    first = basis["chain0"]
    reset[first : first + chain.A.shape[0]] += servo.p * np.outer(chain.B_velocity, moved)
    return reset


def play_endings(servo: Servo, basis: Basis, play: Play, grip: Grip, voltage: Array) -> list[Ending]:
    """What ends a mode of the backlash."""
    side = play.side
    if side == 0:
        apart = basis.row("theta_m") - basis.row("theta_d")
        return [
            (s * apart - 0.5 * basis.row("gap"), "+" if s > 0 else "-", _contact_reset(servo, basis, s), "contact", s)
            for s in (1, -1)
        ]
    flank = "+" if side > 0 else "-"
    if play.held:
        # Accelerations away from the flank's own: free of the load, and under all of it.
        free, pressed = (
            side * flow_of(servo, basis, Play("", s), SMOOTH[0], voltage)[basis["speed"]] - 0.5 * basis.row("gap''")
            for s in (0, side)
        )
        return [(pressed, flank, None, "contact", side), (-free, "open", None, "release", side)]
    reset = _contact_reset(servo, basis, side)
    release = -side * _screw_rate(basis, side) - (_stopping(servo, basis) if grip.side else 0.0)
    if servo.rigid:
        return [(release, "open", reset, "release", side)]
    reset[basis["speed"]] = 0.5 * side * basis.row("gap'")
    return [(release, f"held {flank}", reset, "hold", side)]


def grip_endings(servo: Servo, basis: Basis, grip: Grip) -> list[Ending]:
    """What ends a mode of the friction: the motor stands still, or its torque exceeds the friction's."""
    if grip.stuck:
        # A rigid screw's load does not act back, so the current alone drives the shaft.
        torque = servo.k_T * basis.row("current")
        return [(s * torque - basis.row("friction"), "slip +" if s > 0 else "slip -", None, "slip", s) for s in (1, -1)]
    if grip.side == 0:
        return []
    # A reversal goes through the stuck mode within the instant.
    still = np.eye(len(basis.names))
    still[basis["speed"]] = 0.0
    return [(-grip.side * basis.row("speed") - _stopping(servo, basis), "stick", still, "stick", grip.side)]


def _stopping(servo: Servo, basis: Basis) -> Array:
    """The speed, a hair beyond zero, at which a sliding motor has stopped: 1e-9 of that at which its back EMF takes as
    much voltage as the friction.

    At zero itself a motor whose torque is the friction's to within rounding would stick and slip without end.
    """
    return _HAIR * servo.R / (servo.k_T * servo.k_B) * basis.row("friction")
