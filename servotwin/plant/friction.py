"""Friction on the motor's shaft and on the last mass, as the stick-slip modes of the automaton.

Of each {stick, slip -, slip +}, with a Stribeck drop also {slow -, slow +}; without friction there is one mode only.
The drop is linear in the speed, so that every mode is affine and nothing but the shape of the drop is approximated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.basis import Basis, GuardRow, PlantNumbers, Stribeck
from servotwin.plant.signals import Array

# A motor has stopped at this part of the speed that its friction takes off (at which a DC motor's back EMF takes as
# much voltage as the friction). At zero itself one whose torque is the friction's to within rounding would stick and
# slip without end.
_STOPPED = 1e-9


@dataclass(frozen=True)
class FrictionState:
    """State of one friction: stuck, sliding in a direction, or none (side 0); slow: where it falls with the speed."""

    name: str
    side: int = 0
    stuck: bool = False
    slow: bool = False


@dataclass(frozen=True)
class StickSlipMode:
    """A mode of the frictions of motor and last mass."""

    motor: FrictionState
    load: FrictionState

    @property
    def name(self) -> str:
        """Name of the mode; of what has friction only."""
        return ", ".join(filter(None, (self.motor.name, self.load.name)))


SMOOTH = FrictionState("")
_COULOMB = (FrictionState("stick", stuck=True), FrictionState("slip -", -1), FrictionState("slip +", 1))
_LOAD = (FrictionState("load stick", stuck=True), FrictionState("load slip -", -1), FrictionState("load slip +", 1))
_SLOW = (FrictionState("slow -", -1, slow=True), FrictionState("slow +", 1, slow=True))
_LOAD_SLOW = (FrictionState("load slow -", -1, slow=True), FrictionState("load slow +", 1, slow=True))
FRICTIONLESS = StickSlipMode(SMOOTH, SMOOTH)


def stick_slip_modes(servo: PlantNumbers, friction: bool) -> tuple[StickSlipMode, ...]:
    """All modes of the frictions; the first is the one at rest. `friction`: there is some on the motor.

    Raises
    ------
    InvalidInput
        There is friction on the motor of a drive that follows its command whatever the load, or on a single mass that
        follows a rigid transmission.
    """
    if friction and not np.any(servo.shaft().E):
        raise InvalidInput("friction on the motor of a drive that follows its command whatever the load: must be 0 N m")
    if servo.guide.friction and servo.chain().D[-1]:
        raise InvalidInput(
            "friction of a load that is one mass behind a rigid transmission acts on nothing: must be 0; "
            "give the friction at the motor instead"
        )
    motors = _states(_COULOMB, _SLOW, servo.motor_stribeck) if friction else (SMOOTH,)
    loads = _states(_LOAD, _LOAD_SLOW, servo.guide.stribeck) if servo.guide.friction else (SMOOTH,)
    return tuple(StickSlipMode(motor, load) for motor in motors for load in loads)


def _states(
    states: tuple[FrictionState, ...], slow: tuple[FrictionState, ...], stribeck: Stribeck
) -> tuple[FrictionState, ...]:
    return states + slow if np.any(stribeck.slope) else states


def resistance(basis: Basis, state: FrictionState, friction: str, speed: int, stribeck: Stribeck) -> Array:
    """Row of the friction (N m or N) against the motion of what slides.

    Parameters
    ----------
    friction : str
        Name of the state of the Coulomb friction.
    speed : int
        Place of the speed among the states.
    """
    sliding = state.side * basis.row(friction)
    if not state.slow:
        return sliding
    return np.asarray(
        sliding + state.side * basis.row(f"{friction} drop") - stribeck.slope * np.eye(len(basis.names))[speed]
    )


def motor_guards(
    servo: PlantNumbers, basis: Basis, mode: StickSlipMode, torques: Mapping[int, Array]
) -> list[GuardRow]:
    """Guards that end a mode of the motor: it stops, or what drives it exceeds its friction.

    Parameters
    ----------
    torques : mapping of int to (..., N) array
        Rows of what drives a stuck motor (N m) forwards (1) and backwards (-1) without friction.
    """
    shaft = _sliding(basis, basis["speed"], "friction", stopping_speed(servo, basis, mode))
    states = _states(_COULOMB, _SLOW, servo.motor_stribeck)
    return [_ended(mode, "motor", guard) for guard in _guards(basis, mode.motor, states, shaft, torques)]


def load_guards(servo: PlantNumbers, basis: Basis, mode: StickSlipMode, force: Array) -> list[GuardRow]:
    """The same for the last mass; `force` (..., N) is the row of what drives it without friction, N."""
    threshold = _STOPPED * servo.guide.yielding * basis.row("load friction")
    mass = _sliding(basis, basis.last_speed(servo), "load friction", threshold)
    states = _states(_LOAD, _LOAD_SLOW, servo.guide.stribeck)
    guards = _guards(basis, mode.load, states, mass, {1: force, -1: force})
    return [_ended(mode, "load", guard) for guard in guards]


@dataclass(frozen=True)
class _Sliding:
    """Place of a speed among the states, row of its friction at rest, row of the speed at which it has stopped, and row
    of the Stribeck speed."""

    speed: int
    friction: Array
    stopping: Array | float
    stribeck: Array


def _sliding(basis: Basis, speed: int, friction: str, stopping: Array | float) -> _Sliding:
    static = basis.row(friction) + basis.row(f"{friction} drop")
    return _Sliding(speed, static, stopping, basis.row(f"{friction} stribeck"))


def _guards(
    basis: Basis, state: FrictionState, states: tuple[FrictionState, ...], body: _Sliding, drives: Mapping[int, Array]
) -> list[GuardRow]:
    stick = states[0]
    # What begins to slide is slow at first; without a drop there is one state of each side.
    backwards, forwards = states[-2:]
    if state.stuck:
        return [
            GuardRow(s * drive - body.friction, (forwards if s > 0 else backwards).name, None, "slip", s)
            for s, drive in drives.items()
        ]
    if state.side == 0:
        return []
    size = len(basis.names)
    faster = state.side * np.eye(size)[body.speed] - body.stribeck
    if not state.slow and len(states) > len(_COULOMB):
        return [GuardRow(-faster, (backwards if state.side < 0 else forwards).name, None, "stribeck", 0)]
    # A reversal goes through the stuck mode within the instant.
    still = np.eye(size)
    still[body.speed] = 0.0
    stopped = -state.side * np.eye(size)[body.speed] - body.stopping
    ends = [GuardRow(stopped, stick.name, still, "stick", state.side)]
    if state.slow:
        ends.append(GuardRow(faster, states[1 if state.side < 0 else 2].name, None, "stribeck", state.side))
    return ends


def _ended(mode: StickSlipMode, body: str, guard: GuardRow) -> GuardRow:
    """A guard of one body, to the mode of both."""
    state = next(each for each in (*_COULOMB, *_LOAD, *_SLOW, *_LOAD_SLOW) if each.name == guard.target)
    return guard._replace(target=replace(mode, **{body: state}).name)


def stopping_speed(servo: PlantNumbers, basis: Basis, mode: StickSlipMode) -> Array | float:
    """Speed (row) beyond zero at which a sliding motor has stopped; 0 in the other modes."""
    return stillness(servo, basis) if mode.motor.side else 0.0


def stillness(servo: PlantNumbers, basis: Basis) -> Array:
    """Speed (row) below which a motor with friction is at rest."""
    return np.asarray(_STOPPED * servo.shaft().yielding * basis.row("friction"))
