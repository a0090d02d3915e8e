"""Coulomb friction on the motor's shaft, as the stick-slip modes {stick, slip -, slip +} of the servo's automaton."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.plant.basis import Basis, GuardRow, PlantNumbers, Play
from servotwin.plant.signals import Array

# A motor has stopped at this part of the speed that its friction takes off (at which a DC motor's back EMF takes as
# much voltage as the friction). At zero itself one whose torque is the friction's to within rounding would stick and
# slip without end.
_STOPPED = 1e-9


@dataclass(frozen=True)
class StickSlipMode:
    """A mode of the friction: stuck, sliding in a direction, or without friction (side 0)."""

    name: str
    side: int = 0
    stuck: bool = False


_FRICTIONLESS = (StickSlipMode(""),)
_COULOMB = (StickSlipMode("stick", stuck=True), StickSlipMode("slip -", -1), StickSlipMode("slip +", 1))


def stick_slip_modes(servo: PlantNumbers, friction: bool) -> tuple[StickSlipMode, ...]:
    """All modes of the friction; the first is the one at rest.

    Raises
    ------
    InvalidInput
        There is friction on an elastic screw.
    """
    if friction and servo.play is Play.HELD:
        raise InvalidInput("friction with an elastic screw that is held in the gap: needs a rigid screw (k_d = inf)")
    if friction and not np.any(servo.shaft().E):
        raise InvalidInput("friction on the motor of a drive that follows its command whatever the load: must be 0 N m")
    return _COULOMB if friction else _FRICTIONLESS


def stick_slip_guards(servo: PlantNumbers, basis: Basis, mode: StickSlipMode, torque: Array) -> list[GuardRow]:
    """Guards that end a mode of the friction: the motor stands still, or the torque on it (row) exceeds the
    friction's."""
    if mode.stuck:
        return [
            GuardRow(s * torque - basis.row("friction"), "slip +" if s > 0 else "slip -", None, "slip", s)
            for s in (1, -1)
        ]
    if mode.side == 0:
        return []
    # A reversal goes through the stuck mode within the instant.
    still = np.eye(len(basis.names))
    still[basis["speed"]] = 0.0
    stopped = -mode.side * basis.row("speed") - stopping_speed(servo, basis, mode)
    return [GuardRow(stopped, "stick", still, "stick", mode.side)]


def stopping_speed(servo: PlantNumbers, basis: Basis, mode: StickSlipMode) -> Array | float:
    """Speed (row) beyond zero at which a sliding motor has stopped; 0 in the other modes."""
    return _STOPPED * servo.shaft().yielding * basis.row("friction") if mode.side else 0.0
