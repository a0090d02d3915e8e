"""Coulomb friction on the motor's shaft and on the last mass, as the stick-slip modes of the automaton.

Of each {stick, slip -, slip +}; without friction there is one mode only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.basis import Basis, GuardRow, PlantNumbers, Play
from servotwin.plant.signals import Array

# A motor has stopped at this part of the speed that its friction takes off (at which a DC motor's back EMF takes as
# much voltage as the friction). At zero itself one whose torque is the friction's to within rounding would stick and
# slip without end.
_STOPPED = 1e-9


@dataclass(frozen=True)
class Grip:
    """State of one friction: stuck, sliding in a direction, or none (side 0)."""

    name: str
    side: int = 0
    stuck: bool = False


@dataclass(frozen=True)
class StickSlipMode:
    """A mode of the frictions of motor and last mass."""

    motor: Grip
    load: Grip

    @property
    def name(self) -> str:
        """Name of the mode; of what has friction only."""
        return ", ".join(filter(None, (self.motor.name, self.load.name)))


SMOOTH = Grip("")
_COULOMB = (Grip("stick", stuck=True), Grip("slip -", -1), Grip("slip +", 1))
_LOAD = (Grip("load stick", stuck=True), Grip("load slip -", -1), Grip("load slip +", 1))
FRICTIONLESS = StickSlipMode(SMOOTH, SMOOTH)


def stick_slip_modes(servo: PlantNumbers, friction: bool) -> tuple[StickSlipMode, ...]:
    """All modes of the frictions; the first is the one at rest. `friction`: there is some on the motor.

    Raises
    ------
    InvalidInput
        There is friction on an elastic screw that is held in the gap, on the motor of a drive that follows its command
        whatever the load, or on a single mass that follows a rigid transmission.
    """
    if friction and servo.play is Play.HELD:
        raise InvalidInput("friction with an elastic screw that is held in the gap: needs a rigid screw (k_d = inf)")
    if friction and not np.any(servo.shaft().E):
        raise InvalidInput("friction on the motor of a drive that follows its command whatever the load: must be 0 N m")
    if servo.guide.friction and servo.chain().D[-1]:
        raise InvalidInput(
            "friction of a load that is one mass behind a rigid transmission acts on nothing: must be 0; "
            "give the friction at the motor instead"
        )
    motors, loads = _COULOMB if friction else (SMOOTH,), _LOAD if servo.guide.friction else (SMOOTH,)
    return tuple(StickSlipMode(motor, load) for motor in motors for load in loads)


def stick_slip_guards(
    servo: PlantNumbers, basis: Basis, mode: StickSlipMode, torque: Array, force: Array
) -> list[GuardRow]:
    """Guards that end a mode: something stops, or what drives it exceeds its friction.

    Parameters
    ----------
    torque, force : (..., N) arrays
        Rows of what drives the motor (N m) and the last mass (N) without friction.
    """
    motor, load = mode.motor, mode.load
    shaft = _Sliding(basis["speed"], basis.row("friction"), stopping_speed(servo, basis, mode))
    ends = [_ended(mode, "motor", guard) for guard in _guards(basis, motor, _COULOMB, shaft, torque)]
    if load is SMOOTH:
        return ends
    threshold = _STOPPED * servo.guide.yielding * basis.row("load friction")
    mass = _Sliding(basis.last_speed(servo), basis.row("load friction"), threshold)
    return ends + [_ended(mode, "load", guard) for guard in _guards(basis, load, _LOAD, mass, force)]


@dataclass(frozen=True)
class _Sliding:
    """Place of a speed among the states, row of its friction, and row of the speed at which it has stopped."""

    speed: int
    friction: Array
    stopping: Array | float


def _guards(basis: Basis, grip: Grip, grips: tuple[Grip, ...], body: _Sliding, drive: Array) -> list[GuardRow]:
    stick, backwards, forwards = grips
    if grip.stuck:
        return [
            GuardRow(s * drive - body.friction, (forwards if s > 0 else backwards).name, None, "slip", s)
            for s in (1, -1)
        ]
    if grip.side == 0:
        return []
    # A reversal goes through the stuck mode within the instant.
    size = len(basis.names)
    still = np.eye(size)
    still[body.speed] = 0.0
    stopped = -grip.side * np.eye(size)[body.speed] - body.stopping
    return [GuardRow(stopped, stick.name, still, "stick", grip.side)]


def _ended(mode: StickSlipMode, body: str, guard: GuardRow) -> GuardRow:
    """A guard of one body, to the mode of both."""
    grip = next(each for each in (*_COULOMB, *_LOAD) if each.name == guard.target)
    return guard._replace(target=replace(mode, **{body: grip}).name)


def stopping_speed(servo: PlantNumbers, basis: Basis, mode: StickSlipMode) -> Array | float:
    """Speed (row) beyond zero at which a sliding motor has stopped; 0 in the other modes."""
    return _STOPPED * servo.shaft().yielding * basis.row("friction") if mode.motor.side else 0.0
