"""Initial state of an axis: at rest under the constant force on its load, its position at zero."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from servotwin.plant.basis import BacklashKind, PlantNumbers
from servotwin.plant.signals import Array
from servotwin.plant.structure import Chain


class Rest(NamedTuple):
    """A plant at rest under a force.

    Attributes
    ----------
    motor : (d,) array
        States of actuator and shaft.
    screw : float
        Angle of the driven end, rad.
    load : (N,) array
        State of the chain.
    command : float
        Command that holds it.
    side : int
        Flank on which the motor holds the load; 0: none.
    """

    motor: Array
    screw: float
    load: Array
    command: float
    side: int


class Resting(PlantNumbers, Protocol):
    """One plant that can rest under a force."""

    @property
    def p(self) -> float:
        """m/rad."""
        ...


def rest_under_force(plant: Resting, gap: float, screw: float) -> Rest | None:
    """Rest of a plant whose load is pushed by more than its friction holds; None: it rests without.

    The measured position is zero: the load hangs from the motor's flank, whose torque holds it. Where the driven end is
    held in the gap, the motor carries nothing; a load on a spring that reaches no flank hangs inside the gap.

    Parameters
    ----------
    plant : Axis
    gap : float
        rad.
    screw : float
        Driven end less motor, rad, of one that is held in the gap.
    """
    guide = plant.guide
    if abs(guide.force) <= guide.friction + guide.stribeck.drop:
        return None
    if plant.backlash_kind is not BacklashKind.FREE:
        load, end = _chain_at_rest(plant, screw if plant.at_motor else None)
        return _held(plant, Rest(np.zeros(0), end, load, 0.0, 0), end - screw, 0.0)
    if plant.at_motor:
        return _hung_on_motor(plant, gap)
    load, end = _chain_at_rest(plant, None)
    force = _shaft_force(plant, load, end)
    side = 1 if force > 0.0 else -1
    return _held(plant, Rest(np.zeros(0), end, load, 0.0, side), end + 0.5 * side * gap, -plant.p * force)


def _hung_on_motor(plant: Resting, gap: float) -> Rest:
    """Rest of a free shaft with the motor at zero."""
    for side in (1, -1):
        load, end = _chain_at_rest(plant, -0.5 * side * gap)
        force = _shaft_force(plant, load, end)
        if side * force > 0.0:
            return _held(plant, Rest(np.zeros(0), end, load, 0.0, side), 0.0, -plant.p * force)
    # The load's own spring carries it between the flanks.
    chain = plant.chain()
    push = np.zeros(chain.A.shape[-1])
    push[-1] = plant.guide.force / float(plant.guide.mass)
    load = np.asarray(np.linalg.solve(chain.A_open, -push), dtype=float)
    return _held(plant, Rest(np.zeros(0), float(load[0]) / plant.p, load, 0.0, 0), 0.0, 0.0)


def _shaft_force(plant: Resting, load: Array, end: float) -> float:
    chain: Chain = plant.chain()
    return float(chain.reaction @ load + chain.reaction_position * plant.p * end)


def _chain_at_rest(plant: Resting, end: float | None) -> tuple[Array, float]:
    """State of the pushed chain and angle of the driven end (rad): with that angle, or with the last mass at zero."""
    chain, guide = plant.chain(), plant.guide
    half = chain.A.shape[-1] // 2
    push = np.zeros(half)
    push[-1] = float(guide.force) / float(guide.mass)
    column = chain.B_position[half:]
    state = np.zeros(2 * half)
    if end is not None:
        state[:half] = np.linalg.solve(chain.A[half:, :half], -push - column * plant.p * end)
        return state, end
    last = np.append(chain.C_last[:half], chain.D[-1])
    system = np.vstack([np.column_stack([chain.A[half:, :half], column]), last])
    found = np.linalg.solve(system, -np.append(push, 0.0))
    state[:half] = found[:half]
    return state, float(found[-1]) / plant.p


def _held(plant: Resting, rest: Rest, angle: float, torque: float) -> Rest:
    """With the motor at an angle (rad), under a torque (N m) from the load."""
    shaft = plant.shaft()
    inner = len(shaft.names) - 2
    rows = slice(0, inner + 1)
    system = np.column_stack([shaft.A[rows, :inner], shaft.B[rows]])
    found = np.linalg.solve(system, -(shaft.A[rows, -1] * angle + shaft.E[rows] * torque))
    return rest._replace(motor=np.append(found[:inner], [0.0, angle]), command=float(found[inner]))
